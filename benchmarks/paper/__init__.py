"""``make paper``: the paper's method, its baseline, other methods and ours on the same data."""
