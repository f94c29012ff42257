"""Pages: templates escape texts, and mark code."""

from mien.pages import render, with_code


def test_code_is_marked_and_everything_else_is_escaped() -> None:
    assert with_code("run `mien <b>` & wait") == "run <code>mien &lt;b&gt;</code> &amp; wait"


def test_texts_of_a_template_are_escaped() -> None:
    page = render("tracking/report/templates/preview.html", refresh=None, picture='"><script>')
    assert "<script>" not in page
    assert "http-equiv" not in page
    assert 'content="3"' in render("tracking/report/templates/preview.html", refresh="3", picture="")
