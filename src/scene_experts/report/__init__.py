"""The web page of one run (RUN/report.html) or of several: one file that needs no other file and no
network."""
