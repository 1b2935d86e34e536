"""The avatar live in the browser: poses, cameras, layers and edits, by a page of our own."""
