"""Experiments: one file per question; they compute and record, `experiments.report` draws.

    python -m experiments list | run CONFIG [--field value …] | report RUN

config.py     what every config shares; a config file is found, read and checked here
runs.py       a run folder: resolved config, provenance, records; resumes where it stopped
registry.py   EXPERIMENTS: name -> config model, units of work, computation, report section
"""
