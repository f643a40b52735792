"""MS-COCO 2017, training part: the photographs that the paper trains on."""

from .download import RemoteDataset, RemoteFile

COCO = RemoteDataset(
    name="coco",
    title="MS-COCO train2017, photographs of everyday scenes",
    files=(
        RemoteFile(
            ("http://images.cocodataset.org/zips/train2017.zip",),
            size=19_336_861_798,
            checksum="md5:cced6f7f71b7629ddf16f17bbcfab6b2",
        ),
    ),
    images=118_287,
    licence="each photograph its own Creative Commons licence (Flickr); see cocodataset.org",
)
