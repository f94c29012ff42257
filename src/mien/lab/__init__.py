"""The lab measures mien itself: people with known truth, speed and quality, and the experiments of the papers."""
