// What the package offers.
export { copyFace, motionFace, motionLength } from "./avatar";
export type { Avatar, Baked, BlendSkinned, Camera, Face, MeshBound, Motion, Rig, Static } from "./avatar";
export { AvatarError, readAny, readMien, readPacked } from "./format";
export { presets, rangeOf, setNamed } from "./named";
export { Poser } from "./rig";
export { standStill } from "./torso";
export { DepthSorter } from "./sort";
export { Renderer } from "./renderer";
export type { Backend, Color, Drawer, View } from "./renderer";
export { Viewer } from "./viewer";
export type { Matrices } from "./viewer";
