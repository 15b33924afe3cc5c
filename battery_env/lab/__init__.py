"""What a laboratory uses: one discharge, many of them, forecasts, and the command line. Nothing else imports it."""
