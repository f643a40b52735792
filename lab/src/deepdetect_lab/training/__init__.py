"""Training: images -> views -> labels -> crops -> weights.

A `CropDataset` and a seeded `CropSampler` make a torch `DataLoader`. `train` does all these steps.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
