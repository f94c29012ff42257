"""The summary of skipped tests names reason and remedy."""

from needs import IS_ROOT, NO_INSTRUCTIONS, NO_TEST_DATA, skipped_lines


def test_skipped_tests_are_counted_by_reason_with_a_remedy() -> None:
    reasons = [f"Skipped: {NO_TEST_DATA}", IS_ROOT, NO_TEST_DATA, f"{NO_INSTRUCTIONS}avx512", "because"]
    assert skipped_lines(reasons) == [
        "5 tests were skipped:",
        "     2  no test data; set MIEN_TEST_DATA to the folder that holds it",
        "     1  root may write everywhere; run the tests as another user",
        "     1  this processor has no avx512; run them on one that has",
        "     1  because",
    ]
    assert skipped_lines([]) == ["No test was skipped."]
