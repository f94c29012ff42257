"""Pages: `pages` fills the templates, `plots` draws their charts, `metric_names` names the figures."""
