"""Pages: `pages` fills the templates and names the figures, `plots` draws charts."""
