/* Greets one program that sends its name, as hello.c does, and ends:  greeter SOCKET */
#include <sinew.h>
#include <stdio.h>
#include <stdlib.h>

#define SECOND UINT64_C(1000000000)

static sinew_status check(sinew_status status)
{
    if (status < 0) {
        fprintf(stderr, "greeter: %s\n", sinew_last_error());
        exit(EXIT_FAILURE);
    }
    return status;
}

static void greet(sinew_endpoint *endpoint, const sinew_received *request)
{
    const char hello[] = { 'H', 'e', 'l', 'l', 'o', ',', ' ' };
    sinew_message reply;
    check(sinew_create_message(endpoint, request->source, request->kind, SINEW_CONTROL,
                               sizeof hello + request->length, &reply));
    memcpy(reply.bytes, hello, sizeof hello);
    memcpy(reply.bytes + sizeof hello, request->bytes, request->length);
    check(sinew_reply(endpoint, request, &reply));
}

int main(int argc, char **argv)
{
    const sinew_options options = { .size = sizeof options, .name = SINEW_TEXT("greeter") };
    const sinew_kind name = sinew_kind_named(SINEW_TEXT("demo.name"));
    sinew_endpoint *endpoint;
    sinew_received request;
    bool has_greeted = false;
    check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint));
    puts("the greeter is there");
    fflush(stdout);
    while (!has_greeted) {
        if (check(sinew_receive_message(endpoint, 60 * SECOND, &request)) == SINEW_NOTHING) {
            fprintf(stderr, "greeter: nobody came within a minute\n");
            return EXIT_FAILURE;
        }
        has_greeted = request.kind == name && request.wants_reply;
        if (has_greeted)
            greet(endpoint, &request);
        check(sinew_settle_message(endpoint, &request, has_greeted ? SINEW_DELIVERED : SINEW_REJECTED_UNKNOWN_KIND));
    }
    check(sinew_unregister(&endpoint));
    return EXIT_SUCCESS;
}
