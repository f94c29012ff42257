"""Tracking from captures to results: every stage in its order, and held-out sequences after the others."""
