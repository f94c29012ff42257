// What three.js makes of a .glb file, in a page; tests/test_other_engines.py bundles it with esbuild.
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

/** A function that draws the file's first scene from `distance` metres with the given weights of its morph targets. */
export async function open(address, side, distance, degrees) {
  const { scene: head } = await new GLTFLoader().loadAsync(address);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(degrees, 1, 0.05, 10);
  const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(side, side);
  scene.background = new THREE.Color(1, 1, 1);
  scene.add(head);
  camera.position.set(0, 0, distance);
  return (weights) => {
    head.traverse(({ morphTargetDictionary: names, morphTargetInfluences: shares }) => {
      shares?.fill(0);
      for (const [name, weight] of Object.entries(names ? weights : {})) shares[names[name]] = weight;
    });
    renderer.render(scene, camera);
    return renderer.domElement.toDataURL();
  };
}
