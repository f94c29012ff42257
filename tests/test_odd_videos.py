"""Videos and pictures with odd names, streams, codecs, announced sizes or references are read or refused."""

import os
import resource
import select
import socket
import struct
import zlib
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from av.stream import Disposition

from capture_helpers import encode, write_gradient_video
from mien.capture.person.crop import whole_picture
from mien.capture.person.given import GivenMattes
from mien.errors import UserError
from mien.evaluation.image_folders import read_picture
from mien.media.decoding import MAX_PICTURE_PIXELS, announced_size, decode_picture
from mien.media.display import Display
from mien.media.output import plan_output
from mien.media.source import FrameSelection, open_source, read_image
from mien.media.video import count_frames, probe_video, read_video_frames, write_video
from mien.media.video_file import MAX_FRAME_PIXELS
from mien.media.writing import write_pictures
from refusals import complaint, refuses

pytestmark = pytest.mark.unchecked
NAMES = (
    "take:1.mp4", "http:x.mp4", "%03d.mp4", "-x.mp4", "a\nb.mp4", "q\"'.mp4", "ü.mp4", "\x1b[2J.mp4", "[red].mp4",
    "glob*?{1,2}.mp4", "concat:a.mp4", "pipe:0", "file:", os.fsdecode(b"bad\xff.mp4"),
)  # fmt: skip


GREY = np.full((48, 64, 3), 100, np.uint8)


def grey(path: Path, codec: str = "libx264", pixels: str = "yuv420p", ticks: tuple[int, ...] = tuple(range(5))) -> Path:
    """Write a clip of one grey picture of 64x48 pixels."""
    frame = av.VideoFrame.from_ndarray(GREY, format="rgb24")
    encode(path, [frame.reformat(format=pixels) for _ in ticks], codec, pixels, ticks=ticks)
    return path


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
    refuses("is 24x10, but the images before it are 20x10; give images of one size", next(frames).picture)


def test_a_codec_that_nobody_knows_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = grey(tmp_path / "a.mp4")
    path.write_bytes(path.read_bytes().replace(b"avc1", b"qq\x1b1"))
    told = complaint(capsys, "capture", path, "--out", tmp_path / "out")
    assert "FFmpeg does not know its codec" in told
    assert "\x1b" not in told


RTP = "c=IN IP4 127.0.0.1\nt=0 0\na=control:http://127.0.0.1:PORT/\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n"
LISTED = "is a playlist, a manifest or a link"
LISTS = {
    ".m3u8": (LISTED, "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXTINF:9,\nNAME\n#EXT-X-ENDLIST\n"),
    ".ffconcat": (LISTED, "ffconcat version 1.0\nfile 'NAME'\n"),
    ".sdp": (LISTED, f"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\n{RTP}"),
    ".mpd": (
        LISTED, '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" '
        'mediaPresentationDuration="PT9S"><Period><AdaptationSet mimeType="video/mp4"><Representation id="0" '
        'bandwidth="1" width="64" height="48"><BaseURL>NAME</BaseURL></Representation></AdaptationSet></Period></MPD>'),
    ".asx": (LISTED, "<asx version='3.0'><entry><ref href='NAME'/></entry></asx>"),
    ".ass": ("of a kind that mien does not open", "[Script Info]\nTitle: x\n"),
    ".txt": ("", "file 'NAME'\n"), ".rtsp": ("", "rtsptext\nrtsp://127.0.0.1:PORT/x\n"),
    ".xml": ("", '<?xml version="1.0"?><CompositionPlaylist><Id>NAME</Id></CompositionPlaylist>'),
    ".qtl": ("", '<?xml version="1.0"?><?quicktime type="application/x-quicktime-media-link"?><embed src="NAME"/>'),
}  # fmt: skip
"""Files that name another file for a player to open, and what is said of them."""


def test_files_that_name_other_files_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No connection is made, neither for the entries of a list nor for a name that looks like an address."""
    monkeypatch.chdir(tmp_path)
    grey(Path("segment.ts"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        address = f"http://127.0.0.1:{port}/x.ts"
        for kind, (told, text) in LISTS.items():
            for name, other in ((f"a{kind}", "segment.ts"), ("a.mp4", "segment.ts"), (f"a{kind}", address)):
                Path(name).write_text(text.replace("NAME", other).replace("PORT", port))
                error = refuses(told or "cannot be read|is ", probe_video, Path(name))
                assert error.startswith(f"{name}: ")
        pytest.raises(UserError, probe_video, Path(address))
        named = Path(address.replace("//", "/"))
        named.parent.mkdir(parents=True)
        grey(tmp_path / "clip.mp4").rename(named)
        assert (count_frames(named), select.select([listener], [], [], 0)[0]) == (5, [])


KINDS = {
    "negative times": ("a.mkv", {"codec": "ffv1", "ticks": (-50, -10, 0, 10, 30)}),
    "an edit list, as telephones trim": ("a.mp4", {"ticks": (-50, -10, 0, 10, 30)}),
    "one frame": ("a.mp4", {"ticks": (0,)}),
    "years of silence": ("a.mkv", {"codec": "ffv1", "ticks": (0, 1, 2, 3, 25 * 86400 * 365)}),
    "alpha": ("a.webm", {"codec": "libvpx-vp9", "pixels": "yuva420p"}),
    "alpha in .mov": ("a.mov", {"codec": "png", "pixels": "rgba"}),
    "ten bits": ("a.mov", {"codec": "prores_ks", "pixels": "yuv422p10le"}),
    "grey": ("a.mkv", {"codec": "ffv1", "pixels": "gray"}),
    "gif": ("a.gif", {"codec": "gif", "pixels": "rgb8"}), "no duration": ("a.h264", {}),
    "transport stream": ("a.ts", {}), "avi": ("a.avi", {"codec": "mjpeg", "pixels": "yuvj420p"}),
}  # fmt: skip


@pytest.mark.parametrize("kind", KINDS)
def test_ordinary_oddities_are_read(kind: str, tmp_path: Path) -> None:
    name, options = KINDS[kind]
    path = grey(tmp_path / name, **options)
    times, pictures = zip(*read_video_frames(path), strict=True)
    shown = 3 if kind.startswith("an edit list") else len(options.get("ticks", range(5)))
    assert len(pictures) == count_frames(path) == shown, "mattes are counted against what is shown"
    assert (np.diff(times) > 0).all()
    assert all(np.abs(picture.astype(int) - GREY).mean() <= 20 for picture in pictures)


def test_what_lies_around_the_video_is_no_obstacle(tmp_path: Path) -> None:
    """Sound that comes first, a title in another encoding, a cover picture, and another ending; a cover is no video."""
    path, sound = tmp_path / "a.txt", av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), "fltp", "mono")
    sound.sample_rate = 8000
    for moving in (True, False):
        with av.open(str(path), "w", format="mp4") as container:
            container.metadata["title"] = "Song X"
            heard, cover = container.add_stream("aac", rate=8000), container.add_stream("png", rate=25)
            cover.width, cover.height, cover.pix_fmt = 16, 16, "rgb24"
            cover.disposition = Disposition.attached_pic
            streams = [(heard, [sound]), (cover, [av.VideoFrame(16, 16, "rgb24")])]
            if moving:
                stream = container.add_stream("mpeg4", rate=25)
                stream.width, stream.height, stream.pix_fmt = 64, 48, "yuv420p"
                streams.append((stream, [av.VideoFrame(64, 48, "yuv420p") for _ in range(3)]))
            for stream, frames in streams:
                container.mux([packet for frame in [*frames, None] for packet in stream.encode(frame)])
        path.write_bytes(path.read_bytes().replace(b"Song X", b"Song \xfc"))
        if moving:
            assert [picture.shape for _, picture in read_video_frames(path)] == [(48, 64, 3)] * 3
            assert count_frames(path) == 3
        else:
            refuses("has a cover picture, but no video stream", probe_video, path)


def test_huge_pictures_inside_of_a_video_are_not_decoded(tmp_path: Path) -> None:
    """Files of 64x48 pixels announce or unpack to 300 megapixels and more."""
    loud, screen, inside, alone = (tmp_path / name for name in ("loud.mov", "screen.gif", "inside.mov", "alone.png"))
    data = grey(loud, "rawvideo", "rgb24").read_bytes()
    size = struct.pack(">HH", 64, 48)
    assert size in data
    loud.write_bytes(data.replace(size, struct.pack(">HH", 12_000, 12_000)))
    data = grey(screen, "gif", "rgb8").read_bytes()
    screen.write_bytes(data[:6] + struct.pack("<HH", 20_000, 20_000) + data[10:])
    alone.write_bytes(png(20_000, 15_000, 2_000))
    with av.open(str(inside), "w") as container:
        stream = container.add_stream("png", rate=25)
        stream.width, stream.height, stream.pix_fmt = 64, 48, "rgb24"
        container.mux(stream.encode(av.VideoFrame.from_ndarray(GREY, format="rgb24")))
        packet = av.Packet(alone.read_bytes())
        packet.stream, packet.pts, packet.dts, packet.time_base = stream, 1, 1, Fraction(1, 25)
        container.mux(packet)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for path, words in (
        (loud, r"have 12000x12000 pixels, more than the 37,748,736 pixels \(8192x4608\)"),
        (screen, "it is damaged, or has more than"),
        (alone, "it is damaged, or has more than the 37,748,736 pixels"),
    ):
        refuses(words, list, read_video_frames(path))
    assert len(list(read_video_frames(inside))) == 1
    assert (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) >> 10 < 200


def test_pixels_that_are_not_square_count_as_they_are_shown() -> None:
    """640x480 with pixels 9,000 times as wide would take 8 GB."""
    with pytest.raises(UserError, match=r"clip: is shown with 5760000x480 pixels, more than the 37,748,736"):
        Display("clip", 9000.0).show(av.VideoFrame(640, 480, "yuv420p"))
    assert Display("clip", 9000.0, 512).show(av.VideoFrame(640, 480, "yuv420p")).shape == (1, 512, 3)
    assert MAX_FRAME_PIXELS == 37_748_736


def png(width: int, height: int, rows: int) -> bytes:
    """Return a black grey PNG that announces a size and holds this many rows of it."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    packer = zlib.compressobj(9)
    row = bytes(width + 1)
    packed = b"".join(packer.compress(row) for _ in range(rows)) + packer.flush()
    header = struct.pack(">IIBBBBB", width, height, 8, 0, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", packed) + chunk(b"IEND", b"")


def tiff(width: int, height: int, order: str) -> bytes:
    entries = ((256, 4, 1, width), (257, 4, 1, height), (258, 3, 1, 8))
    packed = b"".join(struct.pack(order + "HHII", *entry) for entry in entries)
    return (b"II*\0" if order == "<" else b"MM\0*") + struct.pack(order + "IH", 8, len(entries)) + packed


HUGE = {
    "a.png": png(30_000, 30_000, 1),
    "a.jpg": b"\xff\xd8\xff\xe0\x00\x04ab\xff\xff\xc2\x00\x11\x08" + struct.pack(">HH", 30_000, 30_000),
    "a.bmp": b"BM" + bytes(12) + struct.pack("<Iii", 40, 30_000, -30_000),
    "old.bmp": b"BM" + bytes(12) + struct.pack("<IHH", 12, 30_000, 30_000),
    "x.webp": b"RIFF    WEBPVP8X\n\0\0\0\0\0\0\0" + 2 * (29_999).to_bytes(3, "little"),
    "a.tif": tiff(30_000, 30_000, "<"),
    "b.tif": tiff(30_000, 30_000, ">"),
    "jpeg.png": b"\xff\xd8\xff\xc0\x00\x11\x08" + struct.pack(">HH", 30_000, 30_000),
}


@pytest.mark.parametrize("name", HUGE)
def test_a_huge_picture_is_refused_with_its_size(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(HUGE[name] + b"IEND\xaeB`\x82")
    mattes = [lambda _: GivenMattes(tmp_path, (8, 8)).matte(0, whole_picture(8, 8, 8))] * name.endswith(".png")
    for read in (read_image, read_picture, *mattes):
        error = refuses("has 30000x30000 pixels, .* at most 67,108,864", read, path)
        assert error.startswith(f"{path}: ")


@pytest.mark.parametrize("ending", [".png", ".jpg", ".bmp", ".webp", ".tif", ".tiff"])
def test_what_is_announced_is_what_is_decoded(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    for shape in ((7, 13, 3), (13, 7), (1, 1, 3)):
        assert cv2.imwrite(str(path), np.random.default_rng(0).integers(0, 256, shape, dtype=np.uint8))
        assert announced_size(path.read_bytes()) == (shape[1], shape[0])
        assert read_image(path).shape == (*shape[:2], 3)
        for length in range(0, 40, 3):
            assert announced_size(path.read_bytes()[:length]) in (None, (shape[1], shape[0]))


def test_webp_is_read_and_other_kinds_of_pictures_are_not_decoded(tmp_path: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (21, 34, 4), dtype=np.uint8)
    for channels, quality, kind in ((3, 50, b"VP8 "), (3, 101, b"VP8L"), (4, 50, b"VP8X")):
        data = cv2.imencode(".webp", picture[..., :channels], [cv2.IMWRITE_WEBP_QUALITY, quality])[1].tobytes()
        assert (announced_size(data), data[12:16]) == ((34, 21), kind)
    # Other kinds of pictures are not decoded under any name, since every decoder may have faults.
    path = tmp_path / "a.png"
    path.write_bytes(b"P5 2 2 255 abcd")
    assert cv2.imdecode(np.frombuffer(path.read_bytes(), np.uint8), cv2.IMREAD_COLOR) is not None
    assert decode_picture(path, cv2.IMREAD_COLOR) is None
    refuses("cannot be read as an image", read_image, path)
    # Nor is a picture of thousands of scans.
    data = cv2.imencode(".jpg", np.zeros((16, 16, 3), np.uint8), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()
    path.write_bytes(data)
    assert decode_picture(path, cv2.IMREAD_COLOR) is not None
    path.write_bytes(data[:-2] + b"\xff\xda\x00\x08\x01\x01\x00\x01\x3f\x00" * 5000 + b"\xff\xd9")
    assert decode_picture(path, cv2.IMREAD_COLOR) is None
    # The largest picture is read.
    path.write_bytes(png(MAX_PICTURE_PIXELS // 256, 256, 256))
    assert decode_picture(path, cv2.IMREAD_GRAYSCALE) is not None
    path.write_bytes(png(MAX_PICTURE_PIXELS // 256 + 1, 256, 256))
    refuses("at most 67,108,864", decode_picture, path, cv2.IMREAD_GRAYSCALE)
