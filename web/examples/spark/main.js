// Two avatars in a room of three.js with Spark, with a cube that passes before and behind them. Put me.packed beside index.html.
import * as THREE from "three";
import { OrbitControls } from "three/addons/controls/OrbitControls.js";
import { readAny } from "mien-web";
import { enliven } from "mien-web/motion";
import { Stage } from "mien-web/spark";

export async function start(canvas, file) {
  const { avatar, motion } = await readAny(file);
  const renderer = new THREE.WebGLRenderer({ canvas, antialias: false });
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(30, 1, 0.05, 20), stage = new Stage(scene, renderer);
  const box = (color, [x, y, z], size) => {
    const made = new THREE.Mesh(new THREE.BoxGeometry(...size), new THREE.MeshLambertMaterial({ color }));
    made.position.set(x, y, z);
    scene.add(made);
    return made;
  };
  scene.add(new THREE.HemisphereLight(0xffffff, 0xb0a090, 3));
  box(0xd8cfc4, [0, -0.2, 0], [2.4, 0.02, 2.4]);
  box(0xc3d0d6, [0, 0.6, -0.8], [2.4, 1.6, 0.02]);
  const cube = box(0xd05030, [0, 0, 0], [0.07, 0.07, 0.07]);
  const left = stage.add(avatar, motion), right = stage.add(avatar);
  left.node.position.set(-0.13, 0, 0);
  right.node.position.set(0.13, 0, 0);
  right.node.rotation.y = -0.3;
  if (motion) left.play();
  right.alive = (face) => enliven(face, avatar, { idle: true, pointer: null }, performance.now() / 1000);
  camera.position.set(0, 0.1, 1.1);
  const controls = new OrbitControls(camera, canvas), clock = new THREE.Timer();
  renderer.setAnimationLoop((now) => {
    clock.update(now);
    renderer.setSize(canvas.clientWidth, canvas.clientHeight, false);
    camera.aspect = canvas.clientWidth / canvas.clientHeight;
    camera.updateProjectionMatrix();
    const angle = clock.getElapsed();
    cube.position.set(0.13 + 0.2 * Math.sin(angle), 0.02, 0.2 * Math.cos(angle));
    right.lookAt(cube.position.toArray());
    controls.update();
    stage.update(clock.getDelta(), camera);
    renderer.render(scene, camera);
  });
  return { left, right, cube, camera, stage };
}
