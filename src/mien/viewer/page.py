"""What mien changes in viser's page before a browser gets it: the warning of a missing GPU, and the panel on phones."""

import gzip

from websockets.datastructures import Headers
from websockets.http11 import Response

_SCRIPT = """<script>
// mien draws the pictures, not the browser: without these words viser does not ask whether the browser has a GPU.
for (const kind of [self.WebGLRenderingContext, self.WebGL2RenderingContext]) {
  if (!kind) continue;
  const get = kind.prototype.getExtension;
  kind.prototype.getExtension = function (name) {
    return name === "WEBGL_debug_renderer_info" ? null : get.call(this, name);
  };
}
// On phones, viser's panel lies over the avatar: it begins folded, and a touch of its title unfolds it. How wide the
// window is shows only after this script, because the words on the viewport come later in the page.
new MutationObserver((changes, watch) => {
  const isTitle = ({ style }) => style.height === "3.5em" && style.cursor === "pointer";
  const title = [...document.querySelectorAll("div")].find(isTitle);
  if (!title) return;
  watch.disconnect();
  if (matchMedia("(max-width: 36em)").matches) title.click();
}).observe(document, { childList: true, subtree: true });
</script>"""
_HEAD = b"<head>"


def adapted(response: Response) -> Response:
    """The answer with mien's script, if it is viser's page. Any other answer stays as it is."""
    if not response.headers.get("Content-Type", "").startswith("text/html"):
        return response
    packed = response.headers.get("Content-Encoding") == "gzip"
    body = gzip.decompress(response.body) if packed else response.body
    body = body.replace(_HEAD, _HEAD + _SCRIPT.encode(), 1)
    body = gzip.compress(body) if packed else body
    headers = Headers(response.headers.raw_items())
    del headers["Content-Length"]
    headers["Content-Length"] = str(len(body))
    return Response(response.status_code, response.reason_phrase, headers, body)
