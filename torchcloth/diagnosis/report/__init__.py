"""The answer for a person: sentences, pictures, report.html."""
