"""``make evaluate-real`` -> reports/real_data.json: other people's recordings, and round trips through their formats."""
