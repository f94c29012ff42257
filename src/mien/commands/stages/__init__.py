"""The stages as the command line runs them: each reads its folders, skips current results, writes its own folder."""
