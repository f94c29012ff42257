// A page with an avatar whose faces are buttons.
import { presets, rangeOf } from "mien-web";
import "mien-web/element";

const avatar = document.querySelector("mien-avatar"), faces = document.querySelector("nav");
avatar.addEventListener("load", () => {
  for (const name of Object.keys(presets).filter((one) => rangeOf(avatar.viewer.avatar, one))) {
    const button = document.createElement("button");
    button.textContent = name.replaceAll("_", " ");
    button.addEventListener("click", () => (avatar.expression = `${name}:1`));
    faces.append(button);
  }
});
