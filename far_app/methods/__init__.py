"""Ways to retry, by name. A new method is one file with a function from Ingredients to a Method, and one line here."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from far_app.errors import ConfigError
from far_app.methods.bgr import bgr
from far_app.methods.far import far
from far_app.methods.fcpa_only import fcpa_only
from far_app.methods.fcpa_rerank import fcpa_rerank
from far_app.methods.naive import naive, single
from far_app.methods.negative_guidance import negative_guidance
from far_app.methods.perturb import perturb
from far_app.methods.rerank import rerank
from far_app.methods.retry import Act, Ingredients
from far_app.protocols import Method

__all__ = ["METHODS", "Act", "Entry", "Ingredients", "method"]


@dataclass(frozen=True, kw_only=True)
class Entry:
    make: Callable[[Ingredients], Method]
    summary: str
    attempts: int | None = None
    """Attempts a trial, where the method fixes them; None leaves it to the task."""
    needs_critic: bool = False
    needs_demonstrations: bool = False


METHODS: dict[str, Entry] = {
    "dp": Entry(make=single, summary="the base policy, one attempt", attempts=1),
    "nr": Entry(make=naive, summary="naive retry"),
    "perturb": Entry(make=perturb, summary="retry with perturbed actions"),
    "fcpa": Entry(make=fcpa_only, summary="retry after learning from the failure", needs_critic=True),
    "far": Entry(make=far, summary="retry after learning from the failure, with perturbed actions", needs_critic=True),
    "bgr": Entry(
        make=bgr, summary="retry with samples unlike what failed nearby", needs_critic=True, needs_demonstrations=True
    ),
    "rerank": Entry(make=rerank, summary="retry with the best of N samples by Q", needs_critic=True),
    "fcpa-rerank": Entry(
        make=fcpa_rerank,
        summary="learn from the failure, then retry with the best of N samples by Q",
        needs_critic=True,
    ),
    "negative-guidance": Entry(
        make=negative_guidance,
        summary="retry with denoising pushed away from what failed nearby",
        needs_critic=True,
        needs_demonstrations=True,
    ),
}


def method(name: str, ingredients: Ingredients) -> Method:
    """The method of that name, or an error that lists the choices."""
    if name not in METHODS:
        raise ConfigError(f"unknown method '{name}'; choose one of: {', '.join(METHODS)}")
    return METHODS[name].make(ingredients)
