"""Proofs that the scenarios of a suite can be solved, stored as SUITE.proof.json next to the
suite.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import msgspec

from cosim.core.errors import SpecError
from cosim.core.files import write_atomic


class Dropped(msgspec.Struct, frozen=True):
    """Rejected candidate of a scenario.

    reason: short reason, the same for all candidates that failed alike.
    details: of this candidate.

    >>> Dropped(1003, "collision with object", "at 7.2 m").reason
    'collision with object'
    """

    seed: int
    reason: str
    details: str = ""


class Proof(msgspec.Struct, frozen=True, kw_only=True):
    """Proof that a scenario is solvable: the expert finished without failure, with this state hash.

    people_m, obstacles_m: least distance of its body from people and obstacles, absent without any.
    passing_mps: its mean speed past the person of a decoy (`cosim.results.go_on`), absent without.
    dropped: rejected candidates before this one; none for a decoy, which has no own candidates.
    """

    scenario: str
    scenario_hash: str
    expert: str
    expert_version: str
    state_hash: str
    time_s: float
    people_m: float | None = None
    obstacles_m: float | None = None
    passing_mps: float | None = None
    dropped: tuple[Dropped, ...] = ()


class Proofs(msgspec.Struct, frozen=True, kw_only=True):
    """Proofs of a suite.

    first: number of scenarios whose first candidate was accepted.
    dropped: rejected candidates by reason.
    """

    suite: str
    suite_hash: str
    expert: str
    first: int
    dropped: dict[str, int]
    proofs: tuple[Proof, ...]


def proofs_path(suite: Path) -> Path:
    """Return the path of the proofs of the suite in a file."""
    return suite.with_suffix(".proof.json")


def read_proofs(suite: Path) -> Proofs:
    """Read the proofs of a suite file. Raises SpecError if they are missing or unreadable."""
    path = proofs_path(suite)
    try:
        return msgspec.json.decode(path.read_bytes(), type=Proofs)
    except (OSError, msgspec.DecodeError) as error:
        raise SpecError(
            f"{path}: no proofs that can be read: {error}: build the suite again"
        ) from error


def write_proofs(suite: Path, name: str, suite_hash: str, proofs: Sequence[Proof]) -> Proofs:
    """Write the proofs of a suite file, one a line."""
    reasons = Counter(dropped.reason for proof in proofs for dropped in proof.dropped)
    document = Proofs(
        suite=name,
        suite_hash=suite_hash,
        expert=", ".join(sorted({f"{proof.expert} {proof.expert_version}" for proof in proofs})),
        first=sum(not proof.dropped for proof in proofs),
        dropped=dict(sorted(reasons.items(), key=lambda item: (-item[1], item[0]))),
        proofs=tuple(proofs),
    )
    head = msgspec.json.encode(msgspec.structs.replace(document, proofs=()))
    rows = b",\n".join(msgspec.json.encode(proof) for proof in proofs)
    assert head.endswith(b'"proofs":[]}')
    write_atomic(proofs_path(suite), head.removesuffix(b"]}") + b"\n" + rows + b"\n]}\n")
    return document
