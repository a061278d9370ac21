"""What every module may use: types, checks of arguments, parts, trees, precisions, safe arithmetic, the compiler."""
