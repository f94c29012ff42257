"""The page that shows how good an avatar is, and that of a comparison."""
