"""Timing of operations and renderers against each other and against named peers, as ratios of one run.

    settings ─▶ comparison ─▶ race: contestants, interleaved ─▶ records ─▶ tables, JSON

A *race* is a set of contestants that are called in turn, A B C A B C …, so that whatever slows the machine down slows
all of them; a *round* is one turn. What is reported is the ratio of two contestants within a round, its median and
quartiles over the rounds. Contestants that compute the same numbers are compared with each other before anything is
timed. `python -m benchmarks --help` tells how to run it; docs/benchmarks.md what the rows mean.
"""
