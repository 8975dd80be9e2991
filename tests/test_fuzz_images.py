"""Whatever a picture file holds, it is read or refused by name: no traceback, no hang, no flood of memory."""

import numpy as np
import pytest
from confined import limited
from fuzz_images import fuzzed

from capture.decode.exif import read_header
from capture.decode.formats import is_photo_name, read_size
from capture.errors import CaptureError
from capture.photos.photo import read_photo, read_thumbnail
from capture.session.session import load_session

COUNT, SEED = 150, 7  # benchmarks/soak/fuzz_files.py reads a thousand
ROOM = 1 << 30  # bytes beyond what the test process has


def test_fuzzed_pictures_are_read_or_refused_by_name(tmp_path):
    read = 0
    for path in fuzzed(tmp_path, COUNT, SEED):
        for look in (read_photo, read_size, read_header, lambda p: read_thumbnail(p, 32)):
            try:
                with limited(tmp_path, ROOM) as watch:
                    found = look(path)
            except CaptureError as error:
                assert path.name in str(error) and "\n" not in str(error)
                continue
            assert not watch.ran and not watch.written
            if look is read_photo:
                read += 1
                assert found.rgb.dtype == np.float32 and np.isfinite(found.rgb).all()
        path.unlink()
    assert COUNT / 5 < read < COUNT * 0.9  # neither all refused nor all whole


def test_a_folder_of_fuzzed_pictures_is_refused_in_one_sentence(tmp_path):
    (tmp_path / "photos").mkdir()
    kept = [path.name for path in fuzzed(tmp_path / "photos", 40, SEED + 1) if is_photo_name(path)]
    with limited(tmp_path, ROOM), pytest.raises(CaptureError) as refusal:
        load_session(tmp_path)
    assert any(name in str(refusal.value) for name in kept) and "\n" not in str(refusal.value)
