"""The browser console in a real browser: flows, times, size and accessibility."""
