"""The page of `r2p dash` in a real browser: Chromium without a screen, steered by Playwright.

install        gets Chromium and Playwright, where CI or PEERS is set
rig            an emulated robot in a process, the page's server and the browser in a thread
looks          what is wrong with a view: names, roles, contrast, headings, sideways scrolling
"""
