"""The example capture with fewer and smaller photos."""

from pathlib import Path

from PIL import Image

SPOT = Path(__file__).parent.parent / "examples" / "spot"
SIZE = (504, 378)  # half of the example's


def small_example(folder: Path, boards: slice, photos: slice) -> Path:
    """Write these photos of the example to `folder` at half their size, with their EXIF; return the folder."""
    for part, chosen in (("board", boards), ("photos", photos)):
        (folder / part).mkdir(parents=True)
        for file in sorted((SPOT / part).iterdir())[chosen]:
            with Image.open(file) as picture:
                small = picture.resize(SIZE, Image.Resampling.BOX)
                small.save(folder / part / file.name, quality=95, exif=picture.info["exif"])
    (folder / "session.toml").write_bytes((SPOT / "session.toml").read_bytes())
    return folder
