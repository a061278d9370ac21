"""What every module may use: checks of arguments, parts, trees, precisions, safe arithmetic, the compiler."""
