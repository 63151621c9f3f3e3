"""Small helpers that know nothing of cloth: linear algebra, files, caches, torch modes, resumable stores."""
