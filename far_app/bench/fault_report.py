"""The shots of `far bench faults` as a table: figures for the JSON file, lines of Markdown for docs/faults.md."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from far_app.errors import ConfigError
from far_app.session.statistics import percentiles

Shot = Mapping[str, Any]
BEGIN, END = "<!-- far bench faults: begin -->", "<!-- far bench faults: end -->"
WORDS = 118
"""Characters of what the operator read that the table has room for."""


def row(shots: Sequence[Shot]) -> dict[str, Any]:
    """A fault's figures. Milliseconds and millimetres; None where there is nothing of the kind."""

    def spread(key: str) -> dict[str, Any] | None:
        known = [s[key] for s in shots if s.get(key) is not None]
        return percentiles(known, 1e3) if known else None

    def largest(*keys: str) -> float | None:
        known = [s[key] for s in shots for key in keys if s.get(key) is not None]
        return round(max(known), 3) if known else None

    read = [s["words"] for s in shots if s["words"]]
    return {
        "times": len(shots),
        "held": sum(s["held"] for s in shots),
        "hold_ms": spread("hold_s"),
        "told_ms": spread("told_s"),
        "stop_frame_ms": spread("stop_s"),
        "heard_to_frame_ms": spread("heard_s"),
        "machine_late_ms": spread("floor_s"),
        "largest_step_mm": largest("step_mm", "step_after_mm"),
        "targets_outside_box": sum(s["outside"] for s in shots),
        "recording_whole": sum(s["lacking_s"] is not None for s in shots),
        "recording_ends_before_ms": spread("lacking_s"),
        "resumed": sum(s["resumed"] for s in shots),
        "first_target_after_mm": largest("first_mm"),
        "operator_read": max(set(read), key=read.count) if read else "",
    }


def markdown(rows: Mapping[str, Mapping[str, Any]]) -> str:
    """The table."""
    columns: dict[str, Callable[[Mapping[str, Any]], str]] = {
        "Times": lambda r: str(r["times"]),
        "Held": lambda r: f"{r['held']}" if r["held"] else "goes on",
        "Last motion after, ms": lambda r: _spread(r["hold_ms"]),
        "Told after, ms": lambda r: _spread(r["told_ms"]),
        "Largest step, mm": lambda r: f"{r['largest_step_mm']:.2f}",
        "Outside box": lambda r: str(r["targets_outside_box"]),
        "Recording whole": lambda r: str(r["recording_whole"]),
        "It ends before, ms": lambda r: _spread(r["recording_ends_before_ms"]),
        "Resumed": lambda r: f"{r['resumed']}",
        "First target after, mm": lambda r: _number(r["first_target_after_mm"]),
        "The operator reads": lambda r: _shortened(r["operator_read"]),
    }
    lines = [f"| Fault | {' | '.join(columns)} |", "|---" * (len(columns) + 1) + "|"]
    lines += [f"| {name} | {' | '.join(cell(r) for cell in columns.values())} |" for name, r in rows.items()]
    stops = {name: r for name, r in rows.items() if r["stop_frame_ms"]}
    if stops:
        heads = (
            "STOP's frame at the controller, ms", "Times", "After the press", "After the hw server heard it",
            "A bare sleeper on this machine woke late by",
        )  # fmt: skip
        lines += ["", f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]
        lines += [
            f"| {name} | {r['times']} | {_spread(r['stop_frame_ms'], 1)} | {_spread(r['heard_to_frame_ms'], 1)} | "
            f"{_spread(r['machine_late_ms'], 1)} |" for name, r in stops.items()
        ]  # fmt: skip
    return "\n".join(lines)


def write_into(doc: Path, table: str) -> None:
    """Put the table between its marks. Raises ConfigError where they are not."""
    text = doc.read_text()
    if BEGIN not in text or END not in text:
        raise ConfigError(f"{doc} has no place for the table: it needs the lines '{BEGIN}' and '{END}'")
    before, after = text[: text.index(BEGIN)], text[text.index(END) :]
    doc.write_text(f"{before}{BEGIN}\n{table}\n{after}")


def _spread(ms: Mapping[str, Any] | None, digits: int = 0) -> str:
    return f"{ms['p50']:.{digits}f} / {ms['max']:.{digits}f}" if ms is not None else ""


def _number(value: float | None) -> str:
    return f"{value:.2f}" if value is not None else ""


def _shortened(words: str) -> str:
    words = words.replace("|", "/").strip()
    return words if len(words) <= WORDS else words[: WORDS - 1] + "…"
