"""Jobs over many recordings: what there is to do for each, what is done, and who does it."""
