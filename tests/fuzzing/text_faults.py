"""Make faults in tables (csv), in the header of a .ply, and in playlists."""

import csv
import io
from random import Random

from fuzzing.edges import CANARY, PORT, TEXTS, edge_number, put

_CELLS = (
    "", " ", "nan", "inf", "-inf", "1e400", "3e38", "-1", "2", "1e-320", "9" * 400, "9" * 5000, "0x10", "1_000", "٣",
    "1,5", "1.2.3", "--1",
    "+1", "1e", "=1+1", "x" * 200_000, *TEXTS,
)  # fmt: skip
_TIMES = (
    "00:00:00:00", "99:59:59:59", "-1:0:0:0", "0:0:0:1e9", "9" * 400 + ":0:0:0", "0:0:0:" + "9" * 400,
    "0:0:0:0." + "9" * 400,
    "0:0:0:0.", "24:00:00:00", "0:00:00;29", "٣:00:00:00", "5000:0:0:0", "9" * 18 + ":0:0:0", "0:0:99999999:0", ":::",
)  # fmt: skip


def faulty_table(data: bytes, dice: Random) -> tuple[str, bytes]:
    """Make one to three faults in a csv."""
    rows = list(csv.reader(io.StringIO(data.decode())))
    kind = dice.choice(("cell", "cell", "cell", "time", "time", "name", "column", "row", "more", "text", "text"))
    for _ in range(dice.choice((1, 1, 3))):
        row = dice.randrange(len(rows))
        column = dice.randrange(max(1, len(rows[row])))
        if kind == "cell" and rows[row]:
            rows[row][column] = dice.choice(_CELLS) if dice.random() < 0.7 else repr(edge_number(dice))
        elif kind == "time" and rows[row]:
            rows[row][0] = dice.choice(_TIMES)
        elif kind == "name" and rows[0]:
            rows[0][dice.randrange(len(rows[0]))] = dice.choice((*TEXTS, *rows[0], "HeadYaw", "timecode"))
        elif kind == "column":
            change = dice.choice(("remove", "double", "swap"))
            other = dice.randrange(max(1, len(rows[0])))
            rows = [_with_column(cells, column, other, change) for cells in rows]
        elif kind == "row":
            change = dice.randrange(5)
            rows = (
                rows[:row] + rows[row + 1 :], rows + [rows[row]] * dice.choice((1, 300)), rows[:1],
                [*rows[:row], [], *rows[row:]],
                [*rows[:row], rows[row][:column], *rows[row + 1 :]],
            )[change] or [[]]  # fmt: skip
        elif kind == "more":
            rows[row] = rows[row] + [dice.choice(_CELLS)] * dice.choice((1, 1000))
    out = io.StringIO()
    csv.writer(out, lineterminator=dice.choice(("\n", "\n", "\r\n", "\r"))).writerows(rows)
    text = out.getvalue()
    return (kind, text.encode("utf-8", "surrogatepass")) if kind != "text" else _faulty_encoding(text, dice)


def _with_column(cells: list[str], column: int, other: int, change: str) -> list[str]:
    cells = list(cells)
    if column < len(cells) and other < len(cells):
        if change == "remove":
            del cells[column]
        elif change == "double":
            cells.insert(other, cells[column])
        else:
            cells[column], cells[other] = cells[other], cells[column]
    return cells


def _faulty_encoding(text: str, dice: Random) -> tuple[str, bytes]:
    data, at = text.encode("utf-8", "surrogatepass"), dice.randrange(len(text) + 1)
    return "text", dice.choice((
        text.encode("utf-16", "surrogatepass"), b"\xef\xbb\xbf" + data, data[:at] + b"\x00" + data[at:],
        data[:at] + b"\xff" + data[at:],
        data[:at] + b'"' + data[at:], data[:at] + b'"' + b"x" * 200_000 + b'"' + data[at:], data.replace(b",", b";"),
        data.replace(b"\n", b""),
        data[:at], b"", b"\n" * 100_000, b"," * 100_000, data[:at] + b"\x1b[2J" + data[at:], b'"' * 1001,
    ))  # fmt: skip


def _faulty_ply_header(lines: list[str], kind: str, dice: Random) -> None:
    """Make one fault in the lines of a header, in place."""
    places = [index for index, line in enumerate(lines) if line.startswith("property")]
    element = next(index for index, line in enumerate(lines) if line.startswith("element"))
    if kind == "count":
        lines[element] = (
            f"element {dice.choice(('vertex', 'vertex', 'face', '', 'x' * 1000))} "
            f"{dice.choice((edge_number(dice), '9' * 5000, '', 'x'))}"
        )
    elif kind == "type":
        index = dice.choice(places)
        name = lines[index].split()[-1]
        lines[index] = (
            "property "
            f"{dice.choice(('double', 'uchar', 'int', 'list uchar int', 'list float float', 'char', 'x', ''))} {name}"
        )
    elif kind == "property":
        index = dice.choice(places)
        change = dice.choice(("remove", "double", "name", "many"))
        new = {
            "remove": [],
            "double": [lines[index]] * 2,
            "name": [f"property float {dice.choice(TEXTS)}"],
            "many": [lines[index]] * 5000,
        }
        lines[index : index + 1] = new[change]
    elif kind == "format":
        lines[1] = (
            f"format {dice.choice(('ascii', 'binary_big_endian', 'binary_little_endian', '', 'x'))} "
            f"{dice.choice(('1.0', '2.0', ''))}"
        )
    elif kind == "comment":
        numbers = " ".join(str(edge_number(dice)) for _ in range(dice.choice((0, 1, 16, 16, 17, 10_000))))
        words = dice.choice(
            (
                "",
                "x" * 100_000,
                f"mien frame {numbers}",
                f"T_world_local {numbers}",
                *(line[8:] for line in lines if line.startswith("comment")),
            )
        )
        lines.insert(dice.randrange(1, len(lines)), f"comment {words}")
    elif kind == "order":
        dice.shuffle(lines)


def faulty_ply(data: bytes, dice: Random) -> tuple[str, bytes]:
    """One or two faults in the header of a .ply, or in its numbers."""
    head, mark, body = data.partition(b"end_header\n")
    lines = head.decode("latin1").splitlines()
    kind = dice.choice(
        ("count", "count", "type", "property", "format", "comment", "order", "numbers", "numbers", "body", "end")
    )
    if kind in ("count", "type", "property", "format", "comment", "order"):
        _faulty_ply_header(lines, kind, dice)
    elif kind == "numbers":
        for _ in range(dice.choice((1, 30))):
            value = dice.choice(
                (
                    b"\x00\x00\xc0\x7f",
                    b"\x00\x00\x80\x7f",
                    b"\xff\xff\x7f\x7f",
                    b"\x00\x00\x80\xff",
                    b"\x01\x00\x00\x00",
                    dice.randbytes(4),
                )
            )
            body = put(body, 4 * dice.randrange(len(body) // 4), value)
    elif kind == "body":
        body = dice.choice((b"", body[: dice.randrange(len(body))], body + body, b"1 2 3\n" * 10))
    elif kind == "end":
        mark = dice.choice((b"", b"end_header", b"end_header\r\n", b"end_header \n", b"x" * 1_000_000))
    return kind, "\n".join([*lines, ""]).encode("latin1", "replace") + mark + body


_M3U8 = "#EXTM3U\n#EXT-X-TARGETDURATION:9\n#EXT-X-MEDIA-SEQUENCE:0\n#EXTINF:9,\n{name}\n#EXT-X-ENDLIST\n"
_SDP = (
    "v=0\no=- 0 0 IN IP4 127.0.0.1\ns=x\nc=IN IP4 127.0.0.1\nt=0 0\n"
    f"a=control:http://127.0.0.1:{PORT}/\nm=video 9 RTP/AVP 96\na=rtpmap:96 H264/90000\n"
)
_MPD = (
    '<?xml version="1.0"?><MPD xmlns="urn:mpeg:dash:schema:mpd:2011" type="static" mediaPresentationDuration="PT9S">'
    '<Period><AdaptationSet mimeType="video/mp4"><Representation id="0" bandwidth="1" width="64" height="48">'
    "<BaseURL>{name}</BaseURL></Representation></AdaptationSet></Period></MPD>"
)
_LINK = '<?xml version="1.0"?><?quicktime type="application/x-quicktime-media-link"?><embed src="{name}"/>'


def playlist(clip: str, dice: Random) -> tuple[str, str, bytes]:
    """Return a list that names other files for a player to open: its kind, its ending and its content."""
    name = dice.choice(
        (
            clip,
            f"{CANARY}/clip.mp4",
            f"file:{CANARY}/clip.mp4",
            f"http://127.0.0.1:{PORT}/x.mp4",
            f"tcp://127.0.0.1:{PORT}",
            f"concat:{clip}|{clip}",
        )
    )
    kind, ending, text = dice.choice((
        ("m3u8", ".m3u8", _M3U8.format(name=name)),
        ("ffconcat", ".ffconcat", f"ffconcat version 1.0\nfile '{name}'\n"),
        ("sdp", ".sdp", _SDP),
        ("dash", ".mpd", _MPD.format(name=name)),
        ("concat script", ".txt", f"file '{name}'\n"),
        ("imf", ".xml", f'<?xml version="1.0"?><CompositionPlaylist><Id>{name}</Id></CompositionPlaylist>'),
        ("rtsp", ".txt", f"rtsptext\nrtsp://127.0.0.1:{PORT}/x\n"),
        ("quicktime", ".qtl", _LINK.format(name=name)),
    ))  # fmt: skip
    return kind, dice.choice((ending, ".mp4", ".mov", ".avi", ".png")), text.encode()
