"""Videos with odd names, odd streams, unknown codecs, or references to other files are read or refused."""

import http.server
import os
import resource
import struct
import threading
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from av.stream import Disposition

from capture_helpers import write_gradient_video
from fuzzing.edges import playlists
from mien.capture.display import Display
from mien.capture.source import FrameSelection, open_source
from mien.capture.video import count_frames, probe_video, read_video_frames, write_video
from mien.capture.video_file import MAX_FRAME_PIXELS
from mien.cli import main
from mien.errors import UserError
from mien.export.output import plan_output
from mien.export.pictures import write_pictures
from test_handed_in_pictures import png

pytestmark = pytest.mark.unchecked
NAMES = (
    "take:1.mp4", "http:x.mp4", "%03d.mp4", "-x.mp4", "a\nb.mp4", "q\"'.mp4", "ü.mp4", "\x1b[2J.mp4", "[red].mp4",
    "glob*?{1,2}.mp4", "concat:a.mp4", "pipe:0", "file:", os.fsdecode(b"bad\xff.mp4"),
)  # fmt: skip


@pytest.mark.parametrize("name", NAMES)
def test_any_name_is_a_file(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    path = Path(name)
    pictures = write_gradient_video(Path("clip.mp4"), frames=3)
    Path("clip.mp4").rename(path)
    assert count_frames(path) == probe_video(path).frames == 3
    assert np.abs(np.stack([f for _, f in read_video_frames(path)]).astype(int) - pictures).mean() < 2
    if name.endswith(".mp4"):
        write_video(path, [np.zeros((16, 16, 3), np.uint8)] * 2, 25)
        webm = path.with_suffix(".webm")
        write_pictures(plan_output(webm, 2, True), [np.zeros((16, 16, 4), np.uint8)] * 2, 25)
        assert count_frames(path) == count_frames(webm) == 2
        assert sorted(tmp_path.iterdir()) == sorted([tmp_path / path, tmp_path / webm])


def test_folders_of_pictures_with_odd_names_and_sizes(tmp_path: Path) -> None:
    folder = tmp_path / os.fsdecode(b"take:1 \xff\x1b[2J")
    folder.mkdir()
    for name, width in (("%03d.png", 20), (os.fsdecode(b"a\xfe:\n.png"), 20), ("z.png", 24)):
        (folder / name).write_bytes(png(width, 10, 10))
    source = open_source(folder, FrameSelection(), 25.0)
    assert len(source.content_hash) == 64
    frames = source.frames()
    assert [next(frames).picture().shape for _ in range(2)] == [(10, 20, 3)] * 2
    with pytest.raises(UserError, match="is 24x10, but the images before it are 20x10; give images of one size"):
        next(frames).picture()


def test_a_title_in_another_encoding_is_no_obstacle(tmp_path: Path) -> None:
    path = tmp_path / "a.mp4"
    encode(path, title="Song X")
    path.write_bytes(path.read_bytes().replace(b"Song X", b"Song \xfc"))
    if int(av.__version__.split(".")[0]) < 19:
        with pytest.raises(UnicodeDecodeError):
            av.open(str(path))
    assert count_frames(path) == len(list(read_video_frames(path))) == 5


def test_a_codec_that_nobody_knows_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "a.mp4"
    encode(path)
    path.write_bytes(path.read_bytes().replace(b"avc1", b"qq\x1b1"))
    assert main(["capture", str(path), "--out", str(tmp_path / "out")]) == 2
    told = capsys.readouterr().err.strip().splitlines()
    assert len(told) == 1
    assert "FFmpeg does not know its codec (qq" in told[0]
    assert "\x1b" not in told[0]


LISTS = {
    ".m3u8": "is a playlist", ".ffconcat": "is a list of files for FFmpeg", ".mpd": "is a DASH manifest",
    ".sdp": "description of a stream", ".ass": "of a kind that mien does not open", ".asx": "a link or a playlist",
}  # fmt: skip


@pytest.mark.parametrize("kind", LISTS)
def test_files_that_name_other_files_are_refused(kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    encode(Path("segment.ts"), format_name="mpegts")
    for name in (f"a{kind}", "a.mp4"):
        Path(name).write_text(playlists("segment.ts")[kind])
        with pytest.raises(UserError, match=LISTS[kind]) as error:
            probe_video(Path(name))
        assert str(error.value).startswith(f"{name}: is ")


def test_no_connection_is_made(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No connection is made, neither for the entries of a playlist nor for a name that looks like an address."""
    asked = []

    class Handler(http.server.BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            asked.append(self.path)
            self.send_error(404)

        def log_message(self, format: str, *args: object) -> None:
            pass

    monkeypatch.chdir(tmp_path)
    server = http.server.HTTPServer(("127.0.0.1", 0), Handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    try:
        address = f"http://127.0.0.1:{server.server_port}/x.ts"
        Path("a.m3u8").write_text(playlists(address)[".m3u8"])
        for path in (Path("a.m3u8"), Path(address)):
            with pytest.raises(UserError):
                probe_video(path)
        named = Path(address.replace("//", "/"))
        named.parent.mkdir(parents=True)
        encode(tmp_path / "clip.mp4")
        (tmp_path / "clip.mp4").rename(named)
        assert count_frames(named) == 5
    finally:
        server.shutdown()
        server.server_close()
    assert asked == []


def encode(
    path: Path,
    codec: str = "libx264",
    pixels: str = "yuv420p",
    size: tuple[int, int] = (64, 48),
    ticks: tuple[int, ...] = (0, 1, 2, 3, 4),
    format_name: str | None = None,
    title: str | None = None,
    sound: bool = False,
) -> None:
    """Encode a clip with FFmpeg alone. Sound comes first."""
    with av.open(str(path.absolute()), "w", format=format_name) as container:
        container.metadata.update({} if title is None else {"title": title})
        audio = container.add_stream("pcm_s16le", rate=8000, layout="mono") if sound else None
        stream = container.add_stream(codec, rate=25)
        assert isinstance(stream, av.VideoStream)
        stream.width, stream.height, stream.pix_fmt = *size, pixels
        if audio is not None:
            samples = av.AudioFrame.from_ndarray(np.zeros((1, 800), np.int16), format="s16", layout="mono")
            samples.sample_rate = 8000
            container.mux(audio.encode(samples))
        for tick in ticks:
            picture = np.full((size[1], size[0], 3), 100, np.uint8)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=pixels)
            frame.pts = tick
            container.mux(stream.encode(frame))
        container.mux(stream.encode())


KINDS = {
    "odd size": ("a.mkv", {"codec": "ffv1", "pixels": "yuv444p", "size": (321, 241)}),
    "one pixel": ("a.mkv", {"codec": "ffv1", "pixels": "yuv444p", "size": (1, 1)}),
    "one frame": ("a.mp4", {"ticks": (0,)}),
    "negative times": ("a.mkv", {"codec": "ffv1", "ticks": (-50, -10, 0, 10, 30)}),
    "years of silence": ("a.mkv", {"codec": "ffv1", "ticks": (0, 1, 2, 3, 25 * 86400 * 365)}),
    "alpha": ("a.webm", {"codec": "libvpx-vp9", "pixels": "yuva420p"}),
    "alpha in .mov": ("a.mov", {"codec": "png", "pixels": "rgba"}),
    "ten bits": ("a.mov", {"codec": "prores_ks", "pixels": "yuv422p10le"}),
    "sixteen bits": ("a.mkv", {"codec": "ffv1", "pixels": "gbrp16le"}),
    "grey": ("a.mkv", {"codec": "ffv1", "pixels": "gray"}),
    "gif": ("a.gif", {"codec": "gif", "pixels": "rgb8"}),
    "no duration": ("a.h264", {"format_name": "h264"}),
    "transport stream": ("a.ts", {}),
    "avi": ("a.avi", {"codec": "mjpeg", "pixels": "yuvj420p"}),
    "sound first": ("a.mov", {"sound": True}),
    "under another ending": ("a.txt", {"format_name": "mp4"}),
}


@pytest.mark.parametrize("kind", KINDS)
def test_ordinary_oddities_are_read(kind: str, tmp_path: Path) -> None:
    name, options = KINDS[kind]
    encode(tmp_path / name, **options)
    times, pictures = zip(*read_video_frames(tmp_path / name), strict=True)
    assert len(pictures) == count_frames(tmp_path / name) == len(options.get("ticks", range(5)))
    assert (np.diff(times) > 0).all()
    width, height = options.get("size", (64, 48))
    assert {picture.shape for picture in pictures} == {(height, width, 3)}
    assert all(np.abs(picture.astype(int) - 100).mean() <= 20 for picture in pictures)


def test_frames_that_an_edit_list_leaves_out_are_not_counted(tmp_path: Path) -> None:
    """Telephones trim by such lists, and mattes are counted against what is shown."""
    encode(tmp_path / "a.mp4", ticks=(-50, -10, 0, 10, 30))
    assert count_frames(tmp_path / "a.mp4") == len(list(read_video_frames(tmp_path / "a.mp4"))) == 3


def test_a_cover_picture_is_no_video(tmp_path: Path) -> None:
    """A cover picture, as music programs add to files, is not a video. A film may have one, too."""
    for moving in (True, False):
        path = tmp_path / "a.mp4"
        with av.open(str(path), "w") as container:
            cover = container.add_stream("png", rate=25)
            cover.width, cover.height, cover.pix_fmt = 16, 16, "rgb24"
            cover.disposition = Disposition.attached_pic
            stream = container.add_stream("mpeg4", rate=25) if moving else container.add_stream("aac", rate=8000)
            if isinstance(stream, av.VideoStream):
                stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
                frames = [av.VideoFrame(64, 48, "yuv420p") for _ in range(3)]
            else:
                frames = [av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")]
                frames[0].sample_rate = 8000
            container.mux(cover.encode(av.VideoFrame(16, 16, "rgb24")))
            container.mux([packet for frame in [*frames, None] for packet in stream.encode(frame)])
        if moving:
            assert [picture.shape for _, picture in read_video_frames(path)] == [(48, 64, 3)] * 3
        else:
            with pytest.raises(UserError, match="has a cover picture, but no video stream"):
                probe_video(path)


# Memory ---------------------------------------------------------------------------------------------------------------


def peak_of(work) -> int:
    """Return the growth of the process's peak memory in MiB."""
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    work()
    return (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10


def announce(path: Path, width: int, height: int) -> None:
    """Change the size that an .mp4 of 64x48 pixels announces."""
    data = path.read_bytes()
    changed = data.replace(struct.pack(">HH", 64, 48), struct.pack(">HH", width, height))
    assert changed != data
    path.write_bytes(changed)


def test_a_video_that_announces_huge_pictures_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mov"
    encode(path, codec="rawvideo", pixels="rgb24")
    announce(path, 12_000, 12_000)
    with pytest.raises(UserError, match=r"have 12000x12000 pixels, more than the 37,748,736 pixels \(8192x4608\)"):
        next(read_video_frames(path))


def test_huge_pictures_inside_of_a_video_are_not_decoded(tmp_path: Path) -> None:
    """The container says 64x48, but they unpack to 300 megapixels."""
    bomb = png(20_000, 15_000, 2_000)
    path = tmp_path / "a.mov"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(np.zeros((48, 64, 3), np.uint8), format="rgb24")))
        packet = av.Packet(bomb)
        packet.stream, packet.pts, packet.dts, packet.time_base = stream, 1, 1, Fraction(1, 25)
        container.mux(packet)
    alone = tmp_path / "a.png"
    alone.write_bytes(bomb)

    def read() -> None:
        assert len(list(read_video_frames(path))) == 1
        with pytest.raises(UserError, match="it is damaged, or has more than the 37,748,736 pixels"):
            list(read_video_frames(alone))

    assert peak_of(read) < 200


def test_a_gif_that_announces_a_huge_screen(tmp_path: Path) -> None:
    path = tmp_path / "a.gif"
    encode(path, codec="gif", pixels="rgb8")
    data = bytearray(path.read_bytes())
    data[6:10] = struct.pack("<HH", 20_000, 20_000)
    path.write_bytes(data)

    def read() -> None:
        with pytest.raises(UserError, match="it is damaged, or has more than"):
            list(read_video_frames(path))

    assert peak_of(read) < 200


def test_pixels_that_are_not_square_count_as_they_are_shown() -> None:
    """640x480 with pixels 9,000 times as wide would take 8 GB."""
    with pytest.raises(UserError, match=r"clip: is shown with 5760000x480 pixels, more than the 37,748,736"):
        Display("clip", 9000.0).show(av.VideoFrame(640, 480, "yuv420p"))
    assert Display("clip", 9000.0, 512).show(av.VideoFrame(640, 480, "yuv420p")).shape == (1, 512, 3)
    assert MAX_FRAME_PIXELS == 37_748_736
