"""Honest statistics of retries: Wilson intervals, paired differences from the same scenes, exact McNemar."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

Z95 = 1.959964


def wilson(successes: int, trials: int) -> tuple[float, float]:
    """95 % interval of a success rate (Wilson 1927)."""
    if trials == 0:
        return 0.0, 1.0
    p, z2 = successes / trials, Z95**2
    centre = (p + z2 / (2 * trials)) / (1 + z2 / trials)
    half = Z95 * math.sqrt(p * (1 - p) / trials + z2 / (4 * trials**2)) / (1 + z2 / trials)
    low = 0.0 if successes == 0 else max(0.0, centre - half)
    high = 1.0 if successes == trials else min(1.0, centre + half)
    return low, high


def mcnemar(only_a: int, only_b: int) -> float:
    """Two-sided exact p of "a and b succeed equally often", from the scenes where they differ."""
    n = only_a + only_b
    tail = sum(math.comb(n, i) for i in range(min(only_a, only_b) + 1)) / 2**n
    return min(1.0, 2.0 * tail)


def paired_difference(a: Sequence[bool], b: Sequence[bool]) -> tuple[float, float, float]:
    """Mean of a − b over the same scenes with its 95 % interval (normal, from the paired differences)."""
    difference = np.asarray(a, float) - np.asarray(b, float)
    half = Z95 * float(difference.std(ddof=1)) / math.sqrt(len(difference)) if len(difference) > 1 else math.inf
    return float(difference.mean()), float(difference.mean()) - half, float(difference.mean()) + half


def solved_within(record: dict[str, Any], attempts: int) -> bool:
    """Whether an episode was a success within so many attempts."""
    return bool(record["success"]) and int(record["attempts"]) <= attempts


def comparison(records: Sequence[dict[str, Any]], arms: Sequence[str], max_attempts: int) -> str:
    """Success by attempt, paired differences against nr and the first attempt, and costs, as Markdown."""
    by_arm = {a: {r["scene"]: r for r in records if r["arm"] == a} for a in arms}
    scenes = sorted(set.intersection(*(set(found) for found in by_arm.values()))) if by_arm else []
    head = "| method | " + " | ".join(f"within {k}" for k in range(1, max_attempts + 1)) + " |"
    lines = [f"{len(scenes)} scenes, up to {max_attempts} attempts, 95 % Wilson intervals.", "", head]
    lines.append("|---" * (max_attempts + 1) + "|")
    for arm in arms:
        cells = []
        for k in range(1, max_attempts + 1):
            count = sum(solved_within(by_arm[arm][s], k) for s in scenes)
            low, high = wilson(count, len(scenes))
            cells.append(f"{100 * count / max(1, len(scenes)):.1f} [{100 * low:.1f}, {100 * high:.1f}]")
        lines.append(f"| {arm} | " + " | ".join(cells) + " |")
    lines += [
        "",
        "| paired difference within " + str(max_attempts) + " | points [95 %] | only left | only right | McNemar p |",
    ]
    lines.append("|---|---|---|---|---|")
    first = [solved_within(by_arm[arms[0]][s], 1) for s in scenes]
    final = {arm: [solved_within(by_arm[arm][s], max_attempts) for s in scenes] for arm in arms}
    pairs = [(f"{a} − nr", final[a], final["nr"]) for a in arms if a != "nr" and "nr" in arms]
    pairs += [(f"{a} − first attempt (dp)", final[a], first) for a in arms]
    for name, left, right in pairs:
        mean, low, high = paired_difference(left, right)
        only_left = sum(x and not y for x, y in zip(left, right, strict=True))
        only_right = sum(y and not x for x, y in zip(left, right, strict=True))
        p = mcnemar(only_left, only_right)
        interval = f"{100 * mean:+.1f} [{100 * low:+.1f}, {100 * high:+.1f}]"
        lines.append(f"| {name} | {interval} | {only_left} | {only_right} | {p:.3g} |")
    lines += ["", "| cost | attempts a scene | ticks a scene | adaptations a scene | seconds an adaptation |"]
    lines.append("|---|---|---|---|---|")
    lines += [f"| {a} | {' | '.join(costs([by_arm[a][s] for s in scenes]))} |" for a in arms]
    return "\n".join(lines)


def costs(records: Sequence[dict[str, Any]]) -> tuple[str, str, str, str]:
    """Attempts, ticks and adaptations a scene; seconds an adaptation, on the machine that ran it."""
    if not records:
        return "–", "–", "–", "–"
    seconds = [a["seconds"] for r in records for a in r.get("adaptations", ()) if a["status"] != "none"]
    ticks = sum(sum(r.get("ticks", ())) for r in records)
    attempts = sum(r["attempts"] for r in records)
    each = (attempts / len(records), ticks / len(records), len(seconds) / len(records))
    return (
        f"{each[0]:.2f}", f"{each[1]:.0f}", f"{each[2]:.2f}",
        f"{float(np.median(seconds)):.1f}" if seconds else "–",
    )  # fmt: skip
