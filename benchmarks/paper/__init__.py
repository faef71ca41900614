"""``make paper``: the paper's method, its baseline and others beside ours, on the same data."""
