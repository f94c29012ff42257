// Sliders of the page, by group, with the range that was filmed.

import { on } from "./controls";
import { rangeOf } from "./named";
import type { Viewer } from "./viewer";

const GROUPS: [string, RegExp][] = [
  ["Jaw", /^jaw|^tongue/],
  ["Mouth", /^mouth/],
  ["Eyes", /^eye/],
  ["Brows", /^brow/],
  ["Cheeks and nose", /^cheek|^nose/],
  ["Other", /./],
];
const AXES = ["nod", "turn", "tilt"];
/** Largest angle of a slider of a joint, in radians. */
const MOST_ANGLE = 0.5;

export const find = <T extends HTMLElement>(id: string) => document.getElementById(id) as T;

export function element<K extends keyof HTMLElementTagNameMap>(name: K, attributes: Record<string, string>, ...inside: (Node | string)[]) {
  const made = document.createElement(name);
  for (const [key, value] of Object.entries(attributes)) made.setAttribute(key, value);
  made.append(...inside);
  return made;
}

/** jawOpen -> jaw open. */
export const readable = (name: string) => name.replace(/_/g, " ").replace(/([a-z])([A-Z])/g, (_, a, b) => `${a} ${b.toLowerCase()}`);

/**
 * Sliders of all expressions, gazes and joints.
 * @param touched Called when a slider moves, before its value is taken.
 * @returns a function that moves them to the face that is shown.
 */
export function addSliders(viewer: Viewer, place: HTMLElement, touched: () => void): () => void {
  const updates: (() => void)[] = [], { avatar, face } = viewer, { filmed, expression_names: names, neutral } = avatar;
  const slider = (label: string, id: string, [least, most]: [number, number], at: number, get: (() => number) | null, set: (value: number) => void) => {
    const input = element("input", { type: "range", id, min: `${least}`, max: `${most}`, step: "0.01", value: "0" });
    on(input, "input", () => {
      touched();
      set(Number(input.value));
      viewer.change();
    });
    updates.push(() => (input.value = `${get?.() ?? 0}`));
    if (filmed && at >= 0) {
      const share = (value: number) => `${Math.round((100 * (Math.min(Math.max(value, least), most) - least)) / (most - least))}%`;
      input.style.setProperty("--a", share(filmed.lowest[at]));
      input.style.setProperty("--b", share(filmed.highest[at]));
      find("filmed").hidden = false;
    }
    return element("label", { for: id }, element("span", {}, label), input);
  };
  const taken = new Set<string>();
  for (const [title, pattern] of GROUPS) {
    const rows: HTMLElement[] = [];
    names.forEach((name, index) => {
      const range = pattern.test(name) && !taken.has(name) ? rangeOf(avatar, name) : undefined;
      if (!range) return;
      taken.add(name);
      const looks = /^eyeLook/.test(name);
      rows.push(slider(readable(name).replace(new RegExp(`^${title.replace(/s$/, "")} `, "i"), ""), name, range, looks ? -1 : index, looks ? null : () => face.expression[index], (value) => viewer.setExpression(name, value)));
    });
    if (rows.length) place.append(element("details", {}, element("summary", {}, title), ...rows));
  }
  const placed = avatar.joint_names.includes("torso") ? ["torso", "neck"] : []; // by `standStill`
  const joints = avatar.joint_names.flatMap((name, joint) =>
    placed.includes(name) ? [] : AXES.map((axis, k) => {
      const at = 3 * joint + k, id = `${name}_${"xyz"[k]}`;
      return slider(`${readable(name)} ${axis}`, id, [-MOST_ANGLE, MOST_ANGLE], neutral.expression.length + at, () => face.joints[at], (value) => (face.joints[at] = value));
    }),
  );
  if (joints.length) place.append(element("details", {}, element("summary", {}, "Joints"), ...joints));
  return () => updates.forEach((update) => update());
}
