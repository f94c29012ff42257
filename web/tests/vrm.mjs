// What @pixiv/three-vrm makes of a .vrm file, in a page; tests/test_glb_avatar.py bundles it with esbuild.
import { VRMLoaderPlugin, VRMMetaLoaderPlugin } from "@pixiv/three-vrm";
import * as THREE from "three";
import { GLTFLoader } from "three/addons/loaders/GLTFLoader.js";

export async function open(address, side) {
  const loader = new GLTFLoader();
  loader.register((parser) => new VRMLoaderPlugin(parser, { metaPlugin: new VRMMetaLoaderPlugin(parser, { needThumbnailImage: true }) }));
  const { vrm } = (await loader.loadAsync(address)).userData;
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, 1, 0.05, 10), aim = new THREE.Object3D();
  const renderer = new THREE.WebGLRenderer({ preserveDrawingBuffer: true });
  renderer.setSize(side, side);
  document.body.append(renderer.domElement);
  scene.background = new THREE.Color(1, 1, 1);
  scene.add(vrm.scene, aim);
  /** The picture with these expressions, looking at a point beside the camera (null: ahead). */
  const shown = (values = {}, look = null, turn = null) => {
    vrm.expressionManager.resetValues();
    for (const [name, value] of Object.entries(values)) vrm.expressionManager.setValue(name, value);
    vrm.lookAt.target = look && aim;
    vrm.lookAt.reset();
    const head = vrm.humanoid.getNormalizedBoneNode("head");
    head.rotation.set(0, turn ?? 0, 0);
    const at = vrm.humanoid.getRawBoneNode("head").getWorldPosition(new THREE.Vector3());
    camera.position.set(at.x, at.y, at.z + 0.8);
    camera.lookAt(at);
    if (look) aim.position.copy(camera.position).add(new THREE.Vector3(...look));
    vrm.update(1 / 60);
    renderer.render(scene, camera);
    return renderer.domElement.toDataURL();
  };
  return { vrm, shown };
}
