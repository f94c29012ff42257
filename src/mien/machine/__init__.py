"""The computer: threads, devices, signals, terminal and progress, and what systems do differently (`system`)."""
