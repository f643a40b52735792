"""Training of the detector, the keypoint ranker, the learned descriptor, and two matchers.

To train the detector, `train` scales images to views, labels the views, and cuts random crops from
them. A `CropDataset` and a seeded `Schedule` make the batches of a torch `DataLoader`.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
