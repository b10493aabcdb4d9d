"""The paper's own simulated results, to lay beside ours: per cent within five attempts, mean ± std of three seeds.

50 episodes a seed; DP is the policy alone, one attempt. Demonstrations are a person's and the policies see pictures,
so these figures show the scale of the effect, not a target for another set-up.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class PaperResult:
    """A column of the paper's main tables."""

    demonstrations: int
    dp: str
    nr: str
    bgr: str
    far: str


PAPER: dict[str, tuple[PaperResult, ...]] = {
    "door": (PaperResult(demonstrations=3, dp="46.7 ± 17.5", nr="80.7 ± 20.5", bgr="80.7 ± 14.5", far="86.7 ± 7.0"),),
    "bread": (PaperResult(demonstrations=15, dp="44.7 ± 8.1", nr="54.0 ± 11.1", bgr="50.7 ± 12.2", far="56.7 ± 1.2"),),
    "stack": (PaperResult(demonstrations=15, dp="42.7 ± 8.3", nr="61.3 ± 16.0", bgr="63.3 ± 21.0", far="68.7 ± 13.3"),),
    "lift": (
        PaperResult(demonstrations=5, dp="50.0 ± 14.4", nr="66.7 ± 11.5", bgr="66.7 ± 11.0", far="84.7 ± 2.3"),
        PaperResult(demonstrations=10, dp="70.7 ± 2.3", nr="87.3 ± 10.3", bgr="84.7 ± 7.6", far="92.0 ± 2.0"),
    ),
    "can": (
        PaperResult(demonstrations=10, dp="42.7 ± 6.1", nr="54.7 ± 7.0", bgr="54.0 ± 5.3", far="58.0 ± 5.3"),
        PaperResult(demonstrations=20, dp="82.7 ± 3.1", nr="86.0 ± 2.0", bgr="90.7 ± 1.2", far="89.3 ± 6.1"),
    ),
    "square": (
        PaperResult(demonstrations=50, dp="19.3 ± 4.2", nr="34.7 ± 9.9", bgr="34.0 ± 8.7", far="38.0 ± 11.1"),
        PaperResult(demonstrations=100, dp="48.0 ± 5.3", nr="60.0 ± 4.0", bgr="60.7 ± 3.1", far="63.3 ± 2.3"),
    ),
}  # fmt: skip
