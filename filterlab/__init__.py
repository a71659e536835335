"""filterlab: sampled volumes as continuous functions, in PyTorch.

    signal ─┐
            ├─▶ Volume ──prefilter──▶ coefficients ──scheme / op──▶ Field ──rays──▶ image ──▶ records ──▶ report
    file  ──┘            └────────────── a Method ─────────────┘     value, gradient

The public names are listed in `__init__.pyi`. They are loaded when first used, so that `filterlab --help` need not wait
for torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
