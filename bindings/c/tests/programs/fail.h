/* The end of a test program after a failed call: the call, its status and the last error. */
#include <sinew.h>

#include <stdio.h>

static int fail(const char *what, sinew_status status)
{
    printf("%s: %d: %s\n", what, (int)status, sinew_last_error());
    return 1;
}
