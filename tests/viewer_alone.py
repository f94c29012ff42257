"""The page that `mien view` serves in a process of its own."""

import subprocess
import urllib.request
from collections.abc import Sequence


def page_of(words: Sequence[str]) -> str:
    """Start a viewer by these words, return its page, and end it. Without an address, return what it told."""
    browser = urllib.request.build_opener(urllib.request.HTTPCookieProcessor())
    with subprocess.Popen(words, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True) as viewer:
        assert viewer.stdout is not None
        told = []
        try:
            for line in viewer.stdout:
                told.append(line)
                if address := next((word for word in line.split() if word.startswith("http://")), None):
                    with browser.open(address, timeout=60) as answer:
                        return answer.read().decode()
        finally:
            viewer.terminate()
    return "".join(told)
