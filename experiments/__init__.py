"""Experiments: one file per question; they compute and record, `experiments.report` draws.

    python -m experiments list | run CONFIG [--field value …] | report RUN

headings.py   a config file is found, and which experiment it is for
config.py     what every config shares, and what is checked before anything is computed
runs.py       a run folder: resolved config, provenance, records; resumes where it stopped
running.py    units of work one after the other, with what is told meanwhile
registry.py   EXPERIMENTS: name -> config model, units of work, computation, report section; imported when asked for
"""
