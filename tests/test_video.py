from fractions import Fraction
from pathlib import Path

import clips
import cv2
import lit_table
import numpy as np
import pytest

from capture.decode import sandbox as confined
from capture.decode.formats import read_size
from capture.decode.video import frames_of, read_clip, read_frame
from capture.errors import CaptureError
from capture.files.names import frame_path
from capture.photos.photo import read_photo, read_stack, read_thumbnail
from reconstruct.run_folder.folder import content_hash

N_FRAMES, FPS = 60, 25.0
CODED = 8  # 8-bit steps that a codec may be off by


def write_counting(path: Path, fourcc: str = "mp4v") -> Path:
    """Every frame is uniformly grey, with a darker stripe on the left and a coloured corner."""
    size = (lit_table.WIDTH, lit_table.HEIGHT)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*fourcc), FPS, size)
    for i in range(N_FRAMES):
        frame = np.full((*size[::-1], 3), grey(i), np.uint8)
        frame[:, :60], frame[:40, -40:] = 10, (40, 90, 200)
        writer.write(frame)
    writer.release()
    return path


def grey(i: int) -> int:
    """Far from that of the neighbouring frames."""
    return 37 * i % 200 + 30


def shown(picture: np.ndarray) -> float:
    return float(picture[120:160, 150:200].mean())


@pytest.mark.parametrize(
    ("suffix", "fourcc"), [(".mp4", "mp4v"), (".mov", "MJPG"), (".mkv", "mp4v"), (".webm", "VP80"), (".avi", "MJPG")]
)
def test_a_frame_is_found_by_its_time_in_every_container(tmp_path, suffix, fourcc):
    path = write_counting(tmp_path / f"clip{suffix}", fourcc)
    times = [time_s for time_s, _ in frames_of(path, 0.0)]
    assert times == pytest.approx(np.arange(N_FRAMES) / FPS, abs=2e-3)  # webm and mkv count milliseconds
    for i in (0, 7, 33, N_FRAMES - 1):
        assert shown(read_frame(path, round(times[i], 3))) == pytest.approx(grey(i), abs=CODED)


def test_the_rotation_in_the_container_is_left_alone(tmp_path):
    plain = write_counting(tmp_path / "a.mp4")
    turned = tmp_path / "b.mp4"
    turned.write_bytes(plain.read_bytes())
    clips.turn_in_container(turned)
    capture = cv2.VideoCapture(str(turned))
    assert capture.read()[1].shape[:2] == (320, 240)  # guards the test: the plain reader does turn it
    clip = read_clip(turned)
    assert (clip.width, clip.height) == (320, 240)
    assert (read_frame(turned, 0.4) == read_frame(plain, 0.4)).all()


def test_a_frame_is_a_photo_like_any_other(tmp_path):
    path = write_counting(tmp_path / "clip.mp4")
    frame = frame_path(path, 0.8)
    photo = read_photo(frame)
    assert not photo.is_linear and photo.path == frame
    assert photo.rgb[20, 300] == pytest.approx([0.578, 0.102, 0.021], abs=0.03)  # RGB, not BGR
    assert read_size(frame) == (320, 240) and read_thumbnail(frame, 80).shape == (60, 80, 3)
    assert read_stack([frame, frame_path(path, 1.2)], 160).rgb.shape == (2, 120, 160, 3)
    hashes = content_hash([frame, path])
    assert len(set(hashes.values())) == 1 and len(hashes) == 2


def test_a_time_without_a_frame_and_a_clip_that_went_away_are_refused(tmp_path):
    path = write_counting(tmp_path / "clip.mp4")
    for time_s in (0.81, 99.0):
        with pytest.raises(CaptureError, match=r"clip\.mp4 has no frame at"):
            read_frame(path, time_s)
    with pytest.raises(CaptureError, match=r"gone\.mp4 is not there"):
        read_photo(frame_path(tmp_path / "gone.mp4", 1.0))


@pytest.mark.parametrize("content", [b"", b"not a clip at all", None])
def test_a_file_that_is_no_clip_or_was_cut_is_refused_by_name(tmp_path, content):
    path = tmp_path / "bad.mp4"
    path.write_bytes(write_counting(tmp_path / "a.mp4").read_bytes()[:3000] if content is None else content)
    with pytest.raises(CaptureError, match=r"bad\.mp4 is no clip that can be decoded"):
        read_clip(path)


# --- what phones encode and OpenCV does not: by PyAV -----------------------------------------------------------------

UNEVEN = (0.0, 0.04, 0.08, 0.3, 0.5, 0.54, 0.7, 0.9)  # s: a variable frame rate
X265 = {"x265-params": "log-level=none", "preset": "ultrafast"}


def encode(path: Path, codec: str, pixels: str, options: dict[str, str], transfer: int | None = None) -> Path:
    """Frames at UNEVEN times in another codec, with the brightness and the stripe of write_counting."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=25, options=options)
        stream.width, stream.height, stream.pix_fmt = lit_table.WIDTH, lit_table.HEIGHT, pixels
        stream.codec_context.time_base = Fraction(1, 1000)
        if transfer:
            stream.codec_context.color_trc = transfer
            stream.codec_context.color_primaries = stream.codec_context.colorspace = 9  # BT.2020
        for i, time_s in enumerate(UNEVEN):
            picture = np.full((lit_table.HEIGHT, lit_table.WIDTH, 3), grey(i), np.uint8)
            picture[:, :60] = 10
            frame = av.VideoFrame.from_ndarray(picture, "rgb24").reformat(format=pixels)
            frame.pts, frame.time_base = round(1000 * time_s), Fraction(1, 1000)
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    return path


@pytest.mark.parametrize(
    ("name", "codec", "pixels", "options"),
    [
        ("hevc.mp4", "libx265", "yuv420p", X265),
        ("hevc10.mov", "libx265", "yuv420p10le", X265),
        ("hevc10.mkv", "libx265", "yuv420p10le", X265),
        ("h264.mp4", "libx264", "yuv420p", {}),
        ("h264_10.mp4", "libx264", "yuv420p10le", {}),
    ],
)
def test_phone_codecs_with_ten_bits_and_uneven_times_are_read_frame_by_frame(tmp_path, name, codec, pixels, options):
    path = encode(tmp_path / name, codec, pixels, options)
    frames = [(time_s, shown(frame)) for time_s, frame in frames_of(path, 0.0)]
    assert [time_s for time_s, _ in frames] == pytest.approx(UNEVEN, abs=1e-3)
    assert [value for _, value in frames] == pytest.approx([grey(i) for i in range(len(UNEVEN))], abs=CODED)
    assert shown(read_frame(path, 0.54)) == pytest.approx(grey(5), abs=CODED)


@pytest.mark.parametrize(("name", "transfer"), [("hlg.mov", 18), ("hlg.mp4", 18), ("pq.mkv", 16)])
def test_an_hdr_clip_is_refused_with_what_to_do(tmp_path, name, transfer):
    path = encode(tmp_path / name, "libx265", "yuv420p10le", X265, transfer)
    with pytest.raises(CaptureError, match=r"is an HDR clip \((HLG|PQ) curve\).* Switch HDR video off"):
        read_clip(path)
    read_clip(encode(tmp_path / f"sdr_{name}", "libx265", "yuv420p10le", X265, 1))


@pytest.mark.parametrize(("name", "codec", "pixels"), [("a.avi", "magicyuv", "gbrp"), ("b.mkv", "ffv1", "yuv420p")])
def test_codecs_that_no_camera_films_in_are_refused_before_they_decode(tmp_path, monkeypatch, name, codec, pixels):
    path = encode(tmp_path / name, codec, pixels, {})
    decoded = []
    monkeypatch.setattr(confined, "IS_CONFINED", False)
    monkeypatch.setattr(cv2.VideoCapture, "grab", lambda self: decoded.append(name))
    with pytest.raises(CaptureError, match=rf"{name} is compressed with .*H\.264 or HEVC"):
        list(frames_of(path, 0.0))
    assert not decoded


def test_a_clip_whose_frames_cannot_be_decoded_is_refused_with_its_codec(tmp_path, monkeypatch):
    path = write_counting(tmp_path / "clip.mp4")
    monkeypatch.setattr(confined, "IS_CONFINED", False)  # what is exchanged here would not be so in another process
    monkeypatch.setattr(cv2.VideoCapture, "grab", lambda self: False)
    with pytest.raises(CaptureError, match=r"no frame of .*clip.mp4 can be decoded \(codec FMP4\)"):
        list(frames_of(path, 0.0))
