"""Proofs that a suite's scenarios can be solved, as they lie beside it: SUITE.proof.json."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import msgspec

from cosim.core.errors import SpecError
from cosim.core.files import write_atomic


class Dropped(msgspec.Struct, frozen=True):
    """A candidate that was not kept. reason: in a few words, the same for all that failed alike;
    details: of this one.

    >>> Dropped(1003, "collision with object", "at 7.2 m").reason
    'collision with object'
    """

    seed: int
    reason: str
    details: str = ""


class Proof(msgspec.Struct, frozen=True, kw_only=True):
    """That a scenario is solvable: the expert came to its end without failure, with this state
    hash.

    people_m, obstacles_m: least room that it had between its body and people and obstacles, absent
    where there are none. dropped: the candidates before this one.
    """

    scenario: str
    scenario_hash: str
    expert: str
    expert_version: str
    state_hash: str
    time_s: float
    people_m: float | None = None
    obstacles_m: float | None = None
    dropped: tuple[Dropped, ...] = ()


class Proofs(msgspec.Struct, frozen=True, kw_only=True):
    """The proofs of a suite. first: scenarios whose first candidate was kept; dropped: candidates
    by reason."""

    suite: str
    suite_hash: str
    expert: str
    first: int
    dropped: dict[str, int]
    proofs: tuple[Proof, ...]


def proofs_path(suite: Path) -> Path:
    """Where the proofs of the suite in a file lie."""
    return suite.with_suffix(".proof.json")


def read_proofs(suite: Path) -> Proofs:
    """The proofs beside a suite's file. Raises SpecError when there are none that can be read."""
    path = proofs_path(suite)
    try:
        return msgspec.json.decode(path.read_bytes(), type=Proofs)
    except (OSError, msgspec.DecodeError) as error:
        raise SpecError(
            f"{path}: no proofs that can be read: {error}: build the suite anew"
        ) from error


def write_proofs(suite: Path, name: str, suite_hash: str, proofs: Sequence[Proof]) -> Proofs:
    """Write the proofs beside a suite's file, one a line."""
    reasons = Counter(dropped.reason for proof in proofs for dropped in proof.dropped)
    whole = Proofs(
        suite=name,
        suite_hash=suite_hash,
        expert=", ".join(sorted({f"{proof.expert} {proof.expert_version}" for proof in proofs})),
        first=sum(not proof.dropped for proof in proofs),
        dropped=dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0]))),
        proofs=tuple(proofs),
    )
    head = msgspec.json.encode(msgspec.structs.replace(whole, proofs=()))
    rows = b",\n".join(msgspec.json.encode(proof) for proof in proofs)
    assert head.endswith(b'"proofs":[]}')
    write_atomic(proofs_path(suite), head.removesuffix(b"]}") + b"\n" + rows + b"\n]}\n")
    return whole
