// The csv of Live Link Face, also as spreadsheets save it. It follows src/mien/driving/live_link_face.py and sides.py.

import { AvatarError } from "./format";
import { axisAngle, multiplied, rotationMatrix } from "./rigid";
import type { Row, Series } from "./series";

const DAY = 86_400, RATES = [24, 25, 30, 48, 50, 60, 90, 120, 240];
/** Slides have the observer's sides in this file. The table is in docs/conventions.md. */
const PERFORMERS: Record<string, string> = { jawleft: "jawright", jawright: "jawleft", mouthleft: "mouthright", mouthright: "mouthleft" };

export function readCsv(text: string, notes: string[]): Series {
  const lines = text.replace(/^\ufeff/, "").split(/\r?\n/).map((line, index) => ({ line, number: index + 1 })).filter(({ line }) => line.trim());
  if (/^"?sep=/i.test(lines[0]?.line ?? "")) lines.shift(); // Excel's own hint, before the header.
  const split = splitter(lines[0]?.line ?? "");
  const header = split(lines[0]?.line ?? "").map((name) => name.trim().toLowerCase());
  if (!header.includes("timecode") || lines.length < 2) throw new AvatarError("is no csv of Live Link Face");
  if (!header.includes("tongueout")) notes.push("has no column TongueOut, so the tongue stays in");
  const rows: (Row | null)[] = [], whole: number[] = [], frames: number[] = [];
  let days = 0, last = 0, most = 0;
  for (const { line, number } of lines.slice(1)) {
    const cells = split(line), [seconds, frame] = timecode(cells[header.indexOf("timecode")] ?? "", number);
    if (whole.length && seconds - last < -DAY / 2) days += DAY; // Past midnight.
    last = seconds;
    whole.push(days + seconds);
    frames.push(frame);
    most = Math.max(most, frame);
    // A lost face has a count of 0.
    rows.push(cells[header.indexOf("blendshapecount")]?.trim() === "0" ? null : rowOf(header, cells, number));
  }
  if (!rows.some((row) => row)) throw new AvatarError("has no row with a face");
  const rate = whole.some((seconds) => seconds !== whole[0]) ? RATES.find((usual) => usual > most) ?? 1000 : 60;
  return { rows, seconds: whole.map((seconds, i) => seconds + frames[i] / rate), slack: 1 / rate };
}

/** What splits a line into cells: at the commas, semicolons or tabs of the header, unless they are in quotes. */
function splitter(header: string): (line: string) => string[] {
  const separator = [",", ";", "\t"].reduce((best, one) => (header.split(one).length > header.split(best).length ? one : best));
  const cell = new RegExp(`(?:^|${separator})(?:"([^"]*)"|([^${separator}]*))`, "g");
  return (line) => (line.includes('"') ? [...line.matchAll(cell)].map(([, quoted, bare]) => quoted ?? bare) : line.split(separator));
}

/** The text of a number, with a decimal comma as a point. */
const withPoint = (text: string) => (text.includes(".") ? text : text.replace(",", "."));

function rowOf(header: string[], cells: string[], line: number): Row {
  const scores = new Map<string, number>();
  header.forEach((name, column) => {
    if (name === "timecode" || name === "blendshapecount") return;
    const text = withPoint(cells[column]?.trim() ?? ""), value = Number(text);
    if (!text || !Number.isFinite(value) || Math.abs(value) > Math.PI) throw new AvatarError(`has ${cells[column] || "nothing"} for ${name} in line ${line}`);
    scores.set(PERFORMERS[name] ?? name, value);
  });
  return { scores, head: turned(scores.get("headyaw") ?? 0, scores.get("headpitch") ?? 0, scores.get("headroll") ?? 0) };
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
