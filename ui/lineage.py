"""The panel of the policy's versions: what came from what and how it did; undo, restore, keep as the base of trials."""

from __future__ import annotations

from html import escape

from far_app.lineage import BASE, PolicyRow, VersionWish, Wish, ancestry
from far_app.telemetry import Telemetry
from ui.keys import UNDO
from ui.panels import AMBER, BLUE, Item

SHOWN = 6


class Lineage:
    """ui.panels.Panel; which version is chosen is the page's own, and every viewer's."""

    name, title, height = "versions", "Policy versions", 25.2

    def __init__(self) -> None:
        self._chosen = ""
        self.items = [
            Item(label="Older", box=(0.8, 15.2, 7.4, 4.1), reason=self._no_older, asks=lambda t: self._step(t, -1)),
            Item(label="Newer", box=(8.7, 15.2, 7.4, 4.1), reason=self._no_newer, asks=lambda t: self._step(t, 1)),
            Item(label="Act with it next", box=(16.6, 15.2, 15.6, 4.1), color=BLUE, reason=self._no_restore,
                 asks=lambda t: VersionWish(wish=Wish.RESTORE, version=self.chosen(t).name)),
            Item(label="Undo the adaptation", box=(0.8, 20.0, 15.3, 4.1), color=AMBER, action=UNDO, reason=no_undo,
                 asks=lambda t: VersionWish(wish=Wish.UNDO)),
            Item(label="Begin trials with it", box=(16.6, 20.0, 15.6, 4.1), color=BLUE, reason=self._no_keep,
                 asks=lambda t: VersionWish(wish=Wish.KEEP, version=self.chosen(t).name)),
        ]  # fmt: skip

    def chosen(self, telemetry: Telemetry) -> PolicyRow:
        """The version the buttons are about; the one that acts until another is chosen."""
        rows = telemetry.versions.rows or (PolicyRow(name=BASE, parent=""),)
        known = {row.name: row for row in rows}
        return known.get(self._chosen) or known.get(telemetry.versions.acting) or rows[-1]

    def _index(self, telemetry: Telemetry) -> int:
        names = [row.name for row in telemetry.versions.rows]
        name = self.chosen(telemetry).name
        return names.index(name) if name in names else 0

    def _step(self, telemetry: Telemetry, by: int) -> None:
        self._chosen = telemetry.versions.rows[self._index(telemetry) + by].name

    def _no_older(self, telemetry: Telemetry) -> str:
        return "" if self._index(telemetry) > 0 else "this is the oldest"

    def _no_newer(self, telemetry: Telemetry) -> str:
        return "" if self._index(telemetry) + 1 < len(telemetry.versions.rows) else "this is the newest"

    def _no_restore(self, telemetry: Telemetry) -> str:
        versions = telemetry.versions
        name = self.chosen(telemetry).name
        return versions.unavailable or ("it acts already" if name == (versions.next or versions.acting) else "")

    def _no_keep(self, telemetry: Telemetry) -> str:
        versions = telemetry.versions
        return versions.unavailable or ("trials begin with it" if self.chosen(telemetry).name == versions.base else "")

    def html(self, telemetry: Telemetry | None) -> str:
        if telemetry is None:
            return '<p class="far-line">No word from the app yet.</p>'
        versions, chosen = telemetry.versions, self.chosen(telemetry)
        if versions.unavailable:
            return f'<p class="far-line tone-warn">{escape(versions.unavailable)}</p>'
        first = max(0, min(self._index(telemetry) - SHOWN // 2, len(versions.rows) - SHOWN))
        rows = "".join(_row(row, telemetry, row.name == chosen.name) for row in versions.rows[first : first + SHOWN])
        line = " ← ".join(ancestry(versions.rows, chosen.name))
        pending = f" · next attempt: {versions.next}" if versions.next else ""
        return (
            f'<p class="far-line">{escape(line + pending)}</p><table><thead><tr><th>version</th><th>from</th>'
            f"<th>pairs</th><th>acted</th><th>solved</th><th></th></tr></thead><tbody>{rows}</tbody></table>"
        )


def no_undo(telemetry: Telemetry) -> str:
    """Why there is nothing to undo; "" when there is."""
    versions = telemetry.versions
    if versions.unavailable:
        return versions.unavailable
    return "" if versions.undo else "no adaptation of this trial to undo"


def _row(row: PolicyRow, telemetry: Telemetry, chosen: bool) -> str:
    versions = telemetry.versions
    words = ["acts"] * (row.name == versions.acting) + ["base"] * (row.name == versions.base)
    cells = (row.name, row.parent or "–", str(row.pairs or "–"), str(row.acted), str(row.solved), ", ".join(words))
    return f'<tr class="{"on" if chosen else ""}">{"".join(f"<td>{escape(cell)}</td>" for cell in cells)}</tr>'
