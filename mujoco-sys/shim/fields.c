// Input of the preprocessor only: prints MuJoCo's lists of array fields, one `@@` record each, for the build
// script.
#include <mujoco/mjxmacro.h>

#undef MJ_M
#define MJ_M(n) n

#define X(type, name, rows, columns) @@ model | type | name | rows | columns @@
MJMODEL_POINTERS
#undef X

#define X(type, name, rows, columns) @@ data | type | name | rows | columns @@
MJDATA_POINTERS
#undef X

#define X(name) @@ size | int | name | 1 | 1 @@
MJMODEL_INTS
#undef X
