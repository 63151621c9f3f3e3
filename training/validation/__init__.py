"""Programs that test the library from outside: another engine, hidden cases, measured data, verification."""
