// Csv of ARKit's blend shapes: of Live Link Face, also as spreadsheets save it, and of other programs. It follows src/mien/driving/sources/live_link_face.py and sides.py.

import { AvatarError } from "./format";
import { axisAngle, multiplied, rotationMatrix } from "./rigid";
import { median, type Row, type Series } from "./series";

const DAY = 86_400, RATES = [24, 25, 30, 48, 50, 60, 90, 120, 240];
/** Columns of times in the file's own clock, and their units in a second. Frame numbers are taken for 30 a second. */
const UNITS: Record<string, number> = { timestamp_ms: 1000, timestampms: 1000, time: 1, frame: 30 };
/** Largest yaw and pitch that a camera sees, in radians, and largest speed of a head in radians a second. */
const MAX_TURN = 1.7, MAX_SPEED = 20;
/** Slides have the observer's sides in this file. The table is in docs/conventions.md. */
const PERFORMERS: Record<string, string> = { jawleft: "jawright", jawright: "jawleft", mouthleft: "mouthright", mouthright: "mouthleft" };

export function readCsv(text: string, notes: string[]): Series {
  const lines = text.replace(/^\ufeff/, "").split(/\r?\n/).map((line, index) => ({ line, number: index + 1 })).filter(({ line }) => line.trim());
  if (/^"?sep=/i.test(lines[0]?.line ?? "")) lines.shift(); // Excel's own hint, before the header.
  const split = splitter(lines[0]?.line ?? "");
  const header = split(lines[0]?.line ?? "").map((name) => name.trim().toLowerCase().replace(/_l$/, "left").replace(/_r$/, "right"));
  const clock = header.includes("timecode") ? undefined : Object.keys(UNITS).find((name) => header.includes(name));
  if ((!header.includes("timecode") && !clock) || lines.length < 2) throw new AvatarError("is no csv of Live Link Face");
  if (clock === "frame") notes.push("has frame numbers and no times, so 30 rows a second are assumed");
  if (!header.includes("tongueout")) notes.push("has no column TongueOut, so the tongue stays in");
  const rows: (Row | null)[] = [], whole: number[] = [], frames: number[] = [];
  let days = 0, last = 0, most = 0;
  for (const { line, number } of lines.slice(1)) {
    const cells = split(line), [seconds, frame] = clock ? [time(cells[header.indexOf(clock)] ?? "", number) / UNITS[clock], 0] : timecode(cells[header.indexOf("timecode")] ?? "", number);
    if (!clock && whole.length && seconds - last < -DAY / 2) days += DAY; // Past midnight.
    last = seconds;
    whole.push(days + seconds);
    frames.push(frame);
    most = Math.max(most, frame);
    // A lost face has a count of 0.
    rows.push(cells[header.indexOf("blendshapecount")]?.trim() === "0" ? null : rowOf(header, cells, number, clock ? {} : PERFORMERS));
  }
  if (!rows.some((row) => row)) throw new AvatarError("has no row with a face");
  if (clock) return checked({ rows, seconds: whole, slack: 0 });
  const rate = whole.some((seconds) => seconds !== whole[0]) ? RATES.find((usual) => usual > most) ?? 1000 : 60;
  return checked({ rows, seconds: whole.map((seconds, i) => seconds + frames[i] / rate), slack: 1 / rate });
}

/** Refuses a head that turns faster than heads do, which is one whose angles are in degrees. */
function checked(series: Series): Series {
  const steps = series.seconds.slice(1).map((time, i) => time - series.seconds[i]), usual = median(steps.filter((step) => step > 0));
  for (const name of ["headyaw", "headpitch", "headroll"])
    steps.forEach((step, i) => {
      const [from, to] = series.rows.slice(i, i + 2).map((row) => row?.scores.get(name)), turn = (to ?? NaN) - (from ?? NaN);
      if (Math.abs(Math.atan2(Math.sin(turn), Math.cos(turn))) / Math.max(step, usual) > MAX_SPEED)
        throw new AvatarError(`has ${to} for ${name} right after ${from}; angles are in radians, so divide degrees by 57.3`);
    });
  return series;
}

/** What splits a line into cells: at the commas, semicolons or tabs of the header, unless they are in quotes. */
function splitter(header: string): (line: string) => string[] {
  const separator = [",", ";", "\t"].reduce((best, one) => (header.split(one).length > header.split(best).length ? one : best));
  const cell = new RegExp(`(?:^|${separator})(?:"([^"]*)"|([^${separator}]*))`, "g");
  return (line) => (line.includes('"') ? [...line.matchAll(cell)].map(([, quoted, bare]) => quoted ?? bare) : line.split(separator));
}

/** The text of a number, with a decimal comma as a point. */
const withPoint = (text: string) => (text.includes(".") ? text : text.replace(",", "."));

function rowOf(header: string[], cells: string[], line: number, sides: Record<string, string>): Row {
  const scores = new Map<string, number>();
  header.forEach((name, column) => {
    if (name === "timecode" || name === "blendshapecount" || name in UNITS) return;
    const text = withPoint(cells[column]?.trim() ?? ""), value = Number(text);
    if (!text || !Number.isFinite(value) || Math.abs(value) > Math.PI) throw new AvatarError(`has ${cells[column] || "nothing"} for ${name} in line ${line}`);
    if (/^(head|lefteye|righteye)(yaw|pitch)$/.test(name) && Math.abs(value) > MAX_TURN) throw new AvatarError(`has ${text} for ${name} in line ${line}; angles are in radians, so divide degrees by 57.3`);
    scores.set(sides[name] ?? name, value);
  });
  return { scores, head: turned(scores.get("headyaw") ?? 0, scores.get("headpitch") ?? 0, scores.get("headroll") ?? 0) };
}

function time(cell: string, line: number): number {
  const text = withPoint(cell.trim());
  if (!text || !Number.isFinite(Number(text))) throw new AvatarError(`has the time "${cell}" in line ${line}`);
  return Number(text);
}

function timecode(cell: string, line: number): [number, number] {
  const found = /^(\d+):(\d+):(\d+)[:;](\d+)(\.\d+)?$/.exec(withPoint(cell.trim()));
  if (!found) throw new AvatarError(`has the timecode "${cell}" in line ${line}`);
  return [3600 * +found[1] + 60 * +found[2] + +found[3], +found[4] + +(found[5] ?? 0)];
}

/** Yaw, then pitch, then roll, in the signs of Unreal. */
function turned(yaw: number, pitch: number, roll: number): number[] {
  const turn = (x: number, y: number, z: number) => rotationMatrix([x, y, z], 0);
  return axisAngle(multiplied(multiplied(turn(0, -yaw, 0), turn(pitch, 0, 0)), turn(0, 0, -roll)));
}
