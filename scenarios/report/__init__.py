"""`report.html`: one file without network, made from what an output folder holds."""
