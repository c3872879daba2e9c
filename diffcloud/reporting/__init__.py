"""Self-contained HTML pages: the report of fits, and the page of recordings."""
