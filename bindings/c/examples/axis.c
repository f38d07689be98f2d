/* One of three axes that come up together and then step together:  axis SOCKET NAME
 * NAME is hip.axis, knee.axis or ankle.axis. Start all three, in any order, on one node or on several. */
#include <sinew.h>
#include <stdio.h>
#include <stdlib.h>

#define SECOND UINT64_C(1000000000)

static void check(sinew_status status)
{
    if (status < 0) {
        fprintf(stderr, "axis: %s\n", sinew_last_error()); /* the missing parties, and the reasons */
        exit(EXIT_FAILURE);
    }
}

int main(int argc, char **argv)
{
    const sinew_text axes[] = { SINEW_TEXT("hip.axis"), SINEW_TEXT("knee.axis"), SINEW_TEXT("ankle.axis") };
    const sinew_options options = { .size = sizeof options, .name = sinew_text_of(argc > 2 ? argv[2] : "hip.axis") };
    /* A phase: an axis that is restarted passes it at once; the others do not home again. */
    const sinew_barrier homed = { .name = SINEW_TEXT("homed"), .parties = axes, .parties_count = 3,
                                  .within_ns = 30 * SECOND, .flags = SINEW_PHASE };
    /* A barrier: all wait for each other, in each round. */
    const sinew_barrier step = { .name = SINEW_TEXT("step"), .parties = axes, .parties_count = 3,
                                 .within_ns = 10 * SECOND };
    sinew_endpoint *endpoint;
    check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint));
    /* Here the axis finds its reference. */
    check(sinew_meet(endpoint, &homed, NULL));
    puts("all axes are homed: this one is armed");
    fflush(stdout);
    for (int round = 0; round < 3; ++round) {
        uint64_t generation;
        check(sinew_meet(endpoint, &step, &generation));
        printf("step %llu\n", (unsigned long long)generation);
        fflush(stdout);
    }
    check(sinew_unregister(&endpoint));
    return EXIT_SUCCESS;
}
