// Guides through what a detector found, without a camera, for tests/test_studio_page.py: what is said after each picture.
import { pathToFileURL } from "node:url";

export default async function guide(script, pictures) {
  const { Guide } = await import(pathToFileURL(script).href), one = new Guide();
  const told = pictures.map(([found, light]) => {
    one.see(found, light);
    return { fault: one.fault?.words ?? null, request: one.request, full: one.full, done: one.done };
  });
  return { told, turned: [...one.turned], moved: [...one.moved], missing: one.missing() };
}
