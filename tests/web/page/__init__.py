"""The modules of the page that need no browser, run by Node.js where it is there."""
