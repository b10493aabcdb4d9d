"""In which order the trials of a plan run, and which letter stands for which method. Pure; from the plan's seed alone.

A block is one scene once under every method, side by side in time, so that whatever drifts over a day (light, wear,
the operator) meets all methods alike. Blocks are in random order within a repetition, methods within a block.
"""

from __future__ import annotations

import random
import string
from dataclasses import dataclass

from far_app.trial_plan.plan import TrialPlan


@dataclass(frozen=True, kw_only=True)
class Slot:
    """One trial of the plan."""

    method: str
    scene: str
    repetition: int
    """1-based."""


def slots(plan: TrialPlan) -> list[Slot]:
    """All trials, in the order in which they are to run. A repetition added later leaves the earlier ones in place."""
    ordered = []
    for repetition in range(1, plan.repetitions + 1):
        draw = random.Random(f"{plan.seed} order {repetition}")
        for scene in draw.sample([s.name for s in plan.scenes], len(plan.scenes)):
            for method in draw.sample([m.name for m in plan.methods], len(plan.methods)):
                ordered.append(Slot(method=method, scene=scene, repetition=repetition))
    return ordered


def letters(plan: TrialPlan) -> dict[str, str]:
    """Method to letter (A, B, … AA …), at random, so that the order in the file tells nothing."""
    words = [_letter(n) for n in range(len(plan.methods))]
    drawn = random.Random(f"{plan.seed} letters").sample(words, len(words))
    return {method.name: word for method, word in zip(plan.methods, drawn, strict=True)}


def _letter(number: int) -> str:
    more, last = divmod(number, 26)
    return (_letter(more - 1) if more else "") + string.ascii_uppercase[last]
