"""Pages: `pages` fills the templates, names the figures, and draws charts."""
