"""The stages as the command line runs them: each reads its folders, skips what is current, writes its own folder."""
