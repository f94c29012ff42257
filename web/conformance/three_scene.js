// What scenes of three.js on the conformance page share, with Spark and without.

/** An empty scene with a background of red, green and blue as the screen shows them, its camera, and what the page does with it. */
export function sceneOf(THREE, renderer, canvas, background, space) {
  renderer.setSize(canvas.width, canvas.height, false);
  const scene = new THREE.Scene(), camera = new THREE.PerspectiveCamera(25, canvas.width / canvas.height, 0.05, 20);
  const shown = (color) => new THREE.Color().setRGB(...color, space);
  scene.background = shown(background);
  const acts = (stage) => ({
    add(avatar, [x, y, z]) {
      const made = stage.add(avatar);
      made.node.position.set(x, y, z);
      return made;
    },
    hide(made, hidden) {
      made.node.visible = !hidden;
    },
    hang(made, place) {
      const parent = new THREE.Group();
      parent.position.set(...place);
      scene.add(parent);
      parent.add(made.node);
    },
    box([x, y, z], size, color) {
      const made = new THREE.Mesh(new THREE.BoxGeometry(size, size, size), new THREE.MeshBasicMaterial({ color: shown(color) }));
      made.position.set(x, y, z);
      scene.add(made);
      return { remove: () => made.removeFromParent() };
    },
    look(eye, target, fov) {
      camera.fov = fov;
      camera.updateProjectionMatrix();
      camera.position.set(...eye);
      camera.lookAt(...target);
    },
    close() {
      stage.dispose();
      renderer.dispose();
    },
  });
  return { scene, camera, acts };
}
