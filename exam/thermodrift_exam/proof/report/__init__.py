"""The page and the Markdown of a proof."""
