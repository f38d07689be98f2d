/* Claims of a test program: a false one is printed with its line and the last error, and ends the program. */
#include <sinew.h>

#include <stdio.h>
#include <stdlib.h>

#define SECOND UINT64_C(1000000000)
#define EXPECT(claim) expect(__LINE__, #claim, (claim))

static void expect(int line, const char *claim, int holds)
{
    if (holds)
        return;
    printf("line %d: not so: %s; %s\n", line, claim, sinew_last_error());
    exit(EXIT_FAILURE);
}
