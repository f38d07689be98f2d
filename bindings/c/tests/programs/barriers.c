/* The results of waits at a barrier that does not open:  barriers SOCKET
 * Each line is a case, its status, and the sentence about it. */
#include <sinew.h>
#include <stdio.h>
#include <stdlib.h>

static sinew_endpoint *endpoint;

static void tell(const char *name, sinew_status status)
{
    printf("%s %d %s\n", name, (int)status, status < 0 ? sinew_last_error() : "done");
    fflush(stdout);
}

int main(int argc, char **argv)
{
    const sinew_options options = { .size = sizeof options, .name = SINEW_TEXT("hip") };
    const sinew_text both[] = { SINEW_TEXT("hip"), SINEW_TEXT("knee") };
    const sinew_text others[] = { SINEW_TEXT("knee"), SINEW_TEXT("ankle") };
    const sinew_text alone[] = { SINEW_TEXT("hip") };
    sinew_barrier barrier = { .name = SINEW_TEXT("ready"), .parties = both, .parties_count = 2, .within_ns = 20000000 };
    uint64_t generation = 0;
    if (sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint) != SINEW_OK)
        return EXIT_FAILURE;
    tell("late", sinew_meet(endpoint, &barrier, &generation));
    barrier.flags = SINEW_PHASE;
    tell("late phase", sinew_meet(endpoint, &barrier, NULL));
    barrier.flags = 0;
    barrier.parties = others;
    tell("no party", sinew_meet(endpoint, &barrier, NULL));
    barrier.parties = alone;
    barrier.parties_count = 1;
    tell("alone", sinew_meet(endpoint, &barrier, &generation));
    tell("again", sinew_meet(endpoint, &barrier, &generation));
    printf("generation %llu\n", (unsigned long long)generation);
    tell("no barrier", sinew_meet(endpoint, NULL, NULL));
    tell("no endpoint", sinew_meet(NULL, &barrier, NULL));
    barrier.flags = 64;
    tell("odd flags", sinew_meet(endpoint, &barrier, NULL));
    barrier.flags = 0;
    barrier.reserved = 7;
    tell("reserved", sinew_meet(endpoint, &barrier, NULL));
    barrier.reserved = 0;
    barrier.parties = NULL;
    tell("no texts", sinew_meet(endpoint, &barrier, NULL));
    return sinew_unregister(&endpoint) == SINEW_OK ? EXIT_SUCCESS : EXIT_FAILURE;
}
