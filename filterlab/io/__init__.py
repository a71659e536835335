"""Files: volumes in and out, images, strict configurations, and writing that is whole or not at all.

The public names are listed in `__init__.pyi`. They are loaded when first used, so that reading a configuration does not
wait for torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
