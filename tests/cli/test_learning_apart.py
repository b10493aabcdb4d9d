"""Where the methods of a run learn: all in one process, which comes with the first and goes with the run."""

from __future__ import annotations

from dataclasses import replace

import torch

from far_app.cli.options import RunOptions
from far_app.cli.processes import Family, run_folder
from far_app.cli.servers import learning
from far_app.learning.apart.here import WorkHere
from far_app.learning.apart.process import WorkProcess
from far_app.learning.cancellation import never
from far_app.learning.unet import ConditionalUnet1d

OPTIONS = RunOptions(learning_threads=2)


def test_all_methods_of_a_run_learn_in_one_process_that_ends_with_it():
    family = Family()
    with run_folder() as folder, learning(folder, family, OPTIONS) as work:
        assert not family.children, "for methods that do not learn there is none"
        there = work()
        assert isinstance(there, WorkProcess) and work() is there
        (child,) = family.children
        asked = ConditionalUnet1d(7, 20, widths=(16, 32)).eval(), 4, torch.zeros(2, 20), torch.ones(2, 3, 8, 7), never
        assert torch.equal(there.candidates(*asked), WorkHere().candidates(*asked))
        assert child.alive(), "it was the process that made them"
        family.end()
        assert not child.alive()


def test_or_all_in_the_loop_s_own():
    family = Family()
    with run_folder() as folder, learning(folder, family, replace(OPTIONS, learning_apart=False)) as work:
        here = work()
        assert isinstance(here, WorkHere) and here.threads == 2 and not family.children
