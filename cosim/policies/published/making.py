"""The command of a published network: it makes the graph that the network's manifest names of the
file upstream."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosim.core.errors import CosimError, MachineError
from cosim.policies.onnx.making import make_graph, write_graph
from cosim.policies.onnx.manifest import file_facts, read_bundle_manifest
from cosim.policies.onnx.weights import NetworkFile, weight_folders


@dataclass(frozen=True)
class PublishedNetwork:
    """policy: its name, and that of its folder here; weights: the file upstream; make: from its
    bytes to the graph's; packages: what that imports."""

    policy: str
    weights: NetworkFile
    make: Callable[[bytes], bytes]
    packages: tuple[str, ...]

    def write(self, path: Path, folder: Path) -> None:
        """Write the graph that the file at `path` makes into a folder. Raises UsageError for
        another file, MachineError where a package is missing, or writes another graph than the one
        that runs take."""
        manifest = read_bundle_manifest(Path(__file__).with_name(self.policy))
        graph = make_graph(self.weights, path, self.make, self.packages)
        wanted = manifest.files[manifest.model]
        found = file_facts(graph)
        if found.blake2b != wanted.blake2b:
            raise MachineError(
                f"{manifest.model}: would be {found.bytes} bytes, BLAKE2b {found.blake2b}, and "
                f"'{self.policy}' takes {wanted.in_words}: this onnx writes it otherwise than "
                "versions 1.19 to 1.23: pip install 'onnx<1.24'"
            )
        write_graph(folder / manifest.model, graph)

    def command(self, arguments: Sequence[str]) -> None:
        """`python -m cosim.policies.published.NAME FILE [-o FOLDER]`, errors of ours in one
        line."""
        parser = argparse.ArgumentParser(f"python -m cosim.policies.published.{self.policy}")
        parser.add_argument("file", type=Path, help=f"{self.weights.name} of {self.weights.source}")
        parser.add_argument(
            "-o",
            "--output",
            type=Path,
            metavar="FOLDER",
            default=weight_folders()[-1],
            help="where to write the graph; %(default)s by default",
        )
        asked = parser.parse_args(arguments)
        try:
            self.write(asked.file, asked.output)
        except CosimError as error:
            sys.exit(f"error: {error}")
