"""The command line, a file for each verb: ``add`` adds its options, ``call`` runs it and returns the exit status."""
