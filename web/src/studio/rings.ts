// The two rings around the face: one fills as the head turns, the other as the face moves.

import { DIRECTIONS, MOTIONS, type Guide } from "./guide";

const NAMESPACE = "http://www.w3.org/2000/svg";
/** Radii of the outline of the face, and of the rings outside of it. */
const FACE = [33, 44], TURNS = [45, 58], MOVES = [53, 66];
const GAP = 0.07;

function element(name: string, attributes: Record<string, string | number>): SVGElement {
  const made = document.createElementNS(NAMESPACE, name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, `${value}`);
  return made;
}

/** A piece of an ellipse from one angle to another, counterclockwise from the right. */
function arc([rx, ry]: number[], from: number, to: number): string {
  const at = (angle: number) => `${(rx * Math.cos(angle)).toFixed(2)} ${(-ry * Math.sin(angle)).toFixed(2)}`;
  return `M${at(from)}A${rx} ${ry} 0 0 0 ${at(to)}`;
}

/** Draws the empty rings, and returns a function that fills them. */
export function addRings(place: SVGElement | HTMLElement): (guide: Guide) => void {
  const outline = element("ellipse", { rx: FACE[0], ry: FACE[1], stroke: "currentColor", "stroke-width": 0.8, "stroke-dasharray": "3 2.4" });
  const dot = element("circle", { r: 2.4, fill: "currentColor" });
  const pieces = (radii: number[], count: number, first: number) =>
    Array.from({ length: count }, (_, k) => {
      const step = (2 * Math.PI) / count, from = first + k * step + GAP / 2, to = from + step - GAP;
      const track = element("path", { d: arc(radii, from, to), class: "track", "stroke-width": 4, "stroke-linecap": "round" });
      const path = element("path", { d: arc(radii, from, to), class: "part", "stroke-width": 4, "stroke-linecap": "round", pathLength: 1, "stroke-dasharray": "0 2", visibility: "hidden" });
      place.append(track, path);
      return path;
    });
  place.replaceChildren(outline, dot);
  const turned = pieces(TURNS, DIRECTIONS, -Math.PI / DIRECTIONS), moved = pieces(MOVES, MOTIONS.length, Math.PI / 2);
  MOTIONS.forEach(({ name }, k) => {
    const angle = Math.PI / 2 + (2 * Math.PI * (k + 0.5)) / MOTIONS.length;
    const text = element("text", { x: (MOVES[0] + 11) * Math.cos(angle), y: -(MOVES[1] + 6) * Math.sin(angle) });
    text.textContent = name;
    place.append(text);
  });
  const show = (path: SVGElement, share: number) => {
    path.setAttribute("stroke-dasharray", `${share} 2`);
    path.setAttribute("class", share >= 1 ? "full" : "part");
    path.setAttribute("visibility", share > 0.03 ? "visible" : "hidden");
  };
  return (guide) => {
    turned.forEach((path, k) => show(path, guide.turned[k]));
    moved.forEach((path, k) => show(path, guide.moved[k]));
    const [left, up] = guide.pointer ?? [0, 0], far = Math.max(1, Math.hypot(left, up));
    dot.setAttribute("cx", `${(-left / far) * (TURNS[0] - 4)}`);
    dot.setAttribute("cy", `${(-up / far) * (TURNS[1] - 4)}`);
    dot.setAttribute("visibility", guide.pointer ? "visible" : "hidden");
  };
}
