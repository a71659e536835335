"""filterlab: sampled volumes as continuous functions, in PyTorch.

    signal ─┐
            ├─▶ Volume ──prefilter──▶ coefficients ──scheme / op──▶ Field ──rays──▶ image ──▶ records ──▶ report
    file  ──┘            └────────────── a Method ─────────────┘     value, gradient

The public names are listed in `__init__.pyi`. They are loaded when first used, so that `filterlab --help` need not wait
for torch.
"""

import lazy_loader

_load, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)


def __getattr__(name: str) -> object:
    """A public name, when it is first used; `__version__` is that of the installed package."""
    if name != "__version__":
        return _load(name)
    from importlib.metadata import version

    return version(__name__)
