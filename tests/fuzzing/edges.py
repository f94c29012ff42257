"""Choose values at edges: numbers and texts that break readers."""

import math
from random import Random
from typing import Any

INTEGERS = (
    0, 1, -1, 2, 7, 255, 256, 65535, 65536, 2**24 + 1, 4 * 10**8, 2**31 - 1, 2**31, -(2**31), 2**32 - 1, 2**32,
    2**53 + 1,
    2**63 - 1, 2**63, -(2**63), 2**64 - 1, 2**64, 10**400, -(10**400),
)  # fmt: skip
FLOATS = (math.nan, math.inf, -math.inf, 3e38, -3e38, 3.5e38, 1e308, 1e-320, -0.0, 0.5, 1e16, 1e-9, 1e30, -1e30)
CANARY, PORT = "@CANARY@", "@PORT@"
"""Placeholders for the folder that nothing may be written into, and for the port that nothing may connect to."""
DEEP = "@DEEP"
"""Placeholder for nested brackets; the digits after it give the depth."""
SCRIPT = "<script>mien_fuzz(1)</script>"
"""Text that must be escaped in every report."""
TEXTS = (
    "", " ", "text", "0", "nan", "null", "x" * 300, "x" * 100_000, "a\nb", "\x1b]0;own\x07\x1b[31mred", "a\x00b",
    "\u202eabc",
    "\ud800", "\x9b31m", "..", ".", "/", "../../x", "../" * 12 + "etc/passwd", f"{CANARY}/victim.json",
    f"../../../..{CANARY}/victim",
    "C:\\x", "con", "-", "--help", "a:b", f"http://127.0.0.1:{PORT}/x", "%s%n", "{0}", SCRIPT, "größer", "\U0001f600",
    "é" * 200,
)  # fmt: skip
LITERALS = (
    "NaN", "inf", "-inf", "1e400", "-1e999", "3e38", "9" * 400, "9" * 5000, "0x10", "01", "1.", ".5", "1e", "--1",
    "1_0", "\u0663", "1,5", "1.2.3", "=1+1", "x" * 200_000, "99:59:59:59", "-1:0:0:0", "0:0:0:1e9",
    "9" * 400 + ":0:0:0", "0:0:0:0." + "9" * 400, "24:00:00:00", "0:00:00;29", "\u0663:00:00:00", "5000:0:0:0",
    ":::", "double", "uchar", "int",
)  # fmt: skip
"""Words of a text that is no json."""
USD_LINES = tuple(line.replace("{name}", name) for name in ("other.usda", f"{CANARY}/x.usda") for line in (
    "subLayers = [@{name}@]", "references = @{name}@", "payload = @{name}@", 'def "a" ( references = @{name}@ ) {}',
    "asset file = @{name}@", "point3f[] positions.timeSamples = { 0: [(1, 2, 3)] }", "float[] opacities = [inf]",
    "point3f[] positions.connect = </avatar.x>", 'variants = { string v = "x" }',
    "matrix4d xformOp:transform = ((1,0,0,0),(0,1,0,0),(0,0,1,0),(0,0,0,nan))",
))  # fmt: skip
_TEBIBYTE = (1 << 40).to_bytes(8, "little")
SMALL_PICKLES = {
    "bytes of a tebibyte": b"\x80\x04\x8e" + _TEBIBYTE + b".",
    "a bytearray of a tebibyte": b"\x80\x05\x96" + _TEBIBYTE + b".",
    "a text of a tebibyte": b"\x80\x04\x8d" + _TEBIBYTE + b".",
    "a frame of a tebibyte": b"\x80\x04\x95" + _TEBIBYTE + b"N.",
    "a memo of two billion": b"]r\xff\xff\xff\x7f.",
    "a memo of digits": b"]p" + b"9" * 4000 + b"\n.",
    "a number of two gigabytes": b"\x8b\xff\xff\xff\x7f.",
    "digits": b"I" + b"9" * 10_000 + b"\n.",
    "a doubled tuple": b"}(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"u.",
    "a doubled tuple for a key": b"}(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"N" + b"u.",
    "a doubled set": b"\x8f(X\x01\x00\x00\x00a" + b"2\x86" * 200 + b"\x90.",
    "thousands of dictionaries": b"}" * 20_000 + b".",
    "names without end": b"ca\nb\n" * 20_000 + b".",
    "nested lists": b"\x80\x02" + b"]" * 5000 + b"a" * 4999 + b".",
    "a stack that is empty": b"0.",
    "a mark that is missing": b"t.",
    "marks": b"(" * 10**5 + b".",
    "a persistent name": b"Pname\n.",
    "an extension": b"\x82\x01.",
    "a cycle": b"}(X\x01\x00\x00\x00fca\nb\n)\x81q\x01}X\x01\x00\x00\x00xh\x01sbu.",
}
"""Pickles that ask for much memory or time."""
_DEPTHS = (2, 100, 500, 990, 1000, 5000, 100_000)


def edge_integer(dice: Random) -> int:
    """Return a whole number at an edge, or beside one."""
    return dice.choice(INTEGERS) + dice.choice((0, 0, 0, 1, -1))


def edge_number(dice: Random) -> int | float:
    """Return a number at an edge."""
    return edge_integer(dice) if dice.random() < 0.5 else dice.choice(FLOATS)


def edge_value(dice: Random) -> Any:
    """Return a json value at an edge."""
    kind = dice.randrange(8)
    if kind < 3:
        return edge_number(dice)
    if kind < 5:
        return dice.choice(TEXTS)
    if kind == 5:
        return f"{DEEP}{dice.choice(_DEPTHS)}"
    return dice.choice(
        (None, True, False, [], {}, [[]], [None], {"": 0}, [0] * 1000, [[0, 0], [0]], {"tensor": "x"}, {"kind": "x"})
    )


def packed_integer(dice: Random, size: int, order: str = "little") -> bytes:
    """Return an edge as an unsigned field of this many bytes."""
    value = edge_integer(dice) if dice.random() < 0.8 else dice.getrandbits(8 * size)
    return (value % (1 << 8 * size)).to_bytes(size, "little" if order == "little" else "big")


def put(data: bytes, at: int, field: bytes) -> bytes:
    """Return `data` with some bytes replaced."""
    return data[:at] + field + data[at + len(field) :]


def playlists(name: str) -> dict[str, str]:
    """Return lists that name another file for a player to open, by their endings."""
    rtp = (
        f"c=IN IP4 127.0.0.1\nt=0 0\na=control:http://127.0.0.1:{PORT}/\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n"
    )
    return {
        ".m3u8": f"#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXT-X-MEDIA-SEQUENCE:0\n#EXTINF:9,\n{name}\n#EXT-X-ENDLIST\n",
        ".ffconcat": f"ffconcat version 1.0\nfile '{name}'\n",
        ".sdp": f"v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\n{rtp}",
        ".mpd": '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" '
        'mediaPresentationDuration="PT9S"><Period><AdaptationSet mimeType="video/mp4"><Representation id="0" '
        f'bandwidth="1" width="64" height="48"><BaseURL>{name}</BaseURL></Representation></AdaptationSet>'
        "</Period></MPD>",
        ".txt": f"file '{name}'\n",
        ".xml": f'<?xml version="1.0"?><CompositionPlaylist><Id>{name}</Id></CompositionPlaylist>',
        ".rtsp": f"rtsptext\nrtsp://127.0.0.1:{PORT}/x\n",
        ".qtl": f'<?xml version="1.0"?><?quicktime type="application/x-quicktime-media-link"?><embed src="{name}"/>',
        ".asx": f"<asx version='3.0'><entry><ref href='{name}'/></entry></asx>",
        ".ass": "[Script Info]\nTitle: x\n",
    }
