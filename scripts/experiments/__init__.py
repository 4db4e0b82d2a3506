"""The experiments of the thesis, on simulated clusters and on Opportunity's panorama."""
