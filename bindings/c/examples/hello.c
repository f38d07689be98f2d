/* Waits for the application "greeter", sends its own name to it, and prints the reply:  hello SOCKET */
#include <sinew.h>
#include <stdio.h>
#include <stdlib.h>

#define TEN_SECONDS UINT64_C(10000000000)

static sinew_status check(sinew_status status)
{
    if (status < 0) {
        fprintf(stderr, "hello: %s\n", sinew_last_error());
        exit(EXIT_FAILURE);
    }
    return status;
}

int main(int argc, char **argv)
{
    const sinew_text name = SINEW_TEXT("greeter");
    const sinew_options options = { .size = sizeof options, .required = &name, .required_count = 1,
                                    .deadline_ns = TEN_SECONDS };
    sinew_endpoint *endpoint;
    sinew_message message;
    sinew_received reply;
    sinew_tid greeter;
    check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), &options, &endpoint));
    if (check(sinew_resolve(endpoint, name, TEN_SECONDS, &greeter)) == SINEW_NOTHING) {
        fprintf(stderr, "hello: the greeter was there, and has gone\n");
        return EXIT_FAILURE;
    }
    check(sinew_create_message(endpoint, greeter, sinew_kind_named(SINEW_TEXT("demo.name")), SINEW_CONTROL, 5, &message));
    memcpy(message.bytes, "Ankle", 5); /* in the memory from which it is read */
    check(sinew_ask(endpoint, &message, TEN_SECONDS, &reply, NULL)); /* whatever this returns, the message is gone */
    printf("%.*s\n", (int)reply.length, (const char *)reply.bytes);
    check(sinew_settle_message(endpoint, &reply, SINEW_DELIVERED));
    check(sinew_unregister(&endpoint));
    return EXIT_SUCCESS;
}
