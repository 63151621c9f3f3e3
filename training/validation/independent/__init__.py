"""The independent engine: cloth in MuJoCo flex with hidden effects, as the truth of synthetic recordings."""
