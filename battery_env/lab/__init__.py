"""What a laboratory uses: files of testers, one discharge, many of them, forecasts, lives, and the command line."""
