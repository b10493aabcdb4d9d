"""What runs a policy when it acts: encoder and DDIM loop, under one version of the weights.

`torch` is the reference, the modules as they are written; every other engine is the same function, faster, one file
each. An engine is compared with the reference where it is built, on this machine (`take`), and one that cannot be built
or differs by more than its tolerance is refused with its reason, and the next one taken. Noise is drawn outside, so
that the same seeds give the same chunk under any engine.

A new engine is one file with an `Entry`, and one line in `ENGINES`.
"""

from __future__ import annotations

from far_app.learning.engines import arranged, cuda_graph, openvino_engine, reference
from far_app.learning.engines.protocol import Engine, EngineError, Entry
from far_app.learning.engines.taking import Choice, Taken, order_of, take

__all__ = ["ENGINES", "Choice", "Engine", "EngineError", "Entry", "Taken", "order_of", "take"]

ENGINES: dict[str, Entry] = {
    e.name: e
    for e in (cuda_graph.ENTRY, openvino_engine.ENTRY, openvino_engine.BF16_ENTRY, arranged.ENTRY, reference.ENTRY)
}
"""By name, in the order in which they are tried where none was measured."""
