"""``make evaluate-real`` -> reports/real_data.json: recordings of other groups, and round trips through formats."""
