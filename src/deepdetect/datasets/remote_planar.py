"""Where Oxford and HPatches are on the web."""

from .contents import known_contents
from .download import RemoteFile
from .oxford import SCENES
from .remote import RemoteDataset

_OXFORD = "https://www.robots.ox.ac.uk/~vgg/research/affine/det_eval_files"
_OXFORD_CHECKSUMS = {
    "graf": "sha256:999871b945ee968a00a0d5f9af957d1382fb9dae1511cdee9553366817b53b5b",
    "boat": "sha256:6e5721f37fbf9c3e974fd05935a42c1670f3e71aa3e5b218807ea046a068c603",
}
"""Of the archives; what is in all of them is checked too."""

OXFORD = RemoteDataset(
    name="oxford",
    title="Oxford Affine Covariant Regions, eight scenes of six images with homographies",
    files=tuple(
        RemoteFile(
            (
                f"{_OXFORD}/{scene}.tar.gz",
                f"{_OXFORD.replace('https:', 'http:')}/{scene}.tar.gz",
            ),
            size=8_000_000,
            checksum=_OXFORD_CHECKSUMS.get(scene),
            into=scene,
        )
        for scene in SCENES
    ),
    images=48,
    licence="research use; Mikolajczyk et al., 2005",
    contents=known_contents("oxford"),
)

HPATCHES = RemoteDataset(
    name="hpatches",
    title="HPatches sequences, 116 scenes of six images with homographies",
    files=(
        RemoteFile(
            (
                "https://huggingface.co/datasets/vbalnt/hpatches/resolve/main/"
                "hpatches-sequences-release.zip",
                "http://icvl.ee.ic.ac.uk/vbalnt/hpatches/hpatches-sequences-release.tar.gz",
            ),
            size=1_400_000_000,
            inside="hpatches-sequences-release",
        ),
    ),
    images=696,
    licence="MIT; Balntas et al., 2017",
    contents=known_contents("hpatches"),
)
