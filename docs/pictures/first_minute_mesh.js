// Draws the .glb file for first_minute.py: three heads, each turned and with another face.

import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

const FACES = [{}, { mouthSmileLeft: 0.7, mouthSmileRight: 0.7 }, { jawOpen: 0.6 }];

export async function start() {
  const renderer = new THREE.WebGLRenderer({ antialias: true });
  renderer.setSize(innerWidth, innerHeight);
  document.body.append(renderer.domElement);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(22, innerWidth / innerHeight, 0.05, 10);
  scene.background = new THREE.Color(0x3d3d3d);
  let morphs = 0;
  for (const [k, face] of FACES.entries()) {
    const { scene: head } = await new GLTFLoader().loadAsync("me.glb");
    head.position.x = 0.28 * (k - 1);
    head.rotation.y = 0.5 * (k - 1);
    scene.add(head);
    head.traverse((part) => {
      const places = part.morphTargetDictionary;
      morphs = Math.max(morphs, Object.keys(places ?? {}).length);
      if (places) for (const [name, value] of Object.entries(face)) part.morphTargetInfluences[places[name]] = value;
    });
  }
  camera.position.set(0, 0.02, 1.3);
  camera.lookAt(0, -0.02, 0);
  renderer.render(scene, camera);
  return { morphs };
}
