/* Says its name to whoever is called "greeter", and prints the reply:  hello SOCKET */
#include <sinew.h>
#include <stdio.h>
#include <stdlib.h>

static void check(sinew_status status)
{
    if (status < 0) {
        fprintf(stderr, "hello: %s\n", sinew_last_error());
        exit(EXIT_FAILURE);
    }
}

int main(int argc, char **argv)
{
    const uint64_t second = UINT64_C(1000000000);
    sinew_endpoint *endpoint;
    sinew_message message;
    sinew_received reply;
    sinew_tid greeter;
    check(sinew_register_transport_address(sinew_text_of(argc > 1 ? argv[1] : ""), NULL, &endpoint));
    check(sinew_resolve(endpoint, SINEW_TEXT("greeter"), second, &greeter));
    check(sinew_create_message(endpoint, greeter, sinew_kind_named(SINEW_TEXT("demo.name")), SINEW_CONTROL, 5, &message));
    memcpy(message.bytes, "Ankle", 5); /* in the memory from which it is read */
    check(sinew_ask(endpoint, &message, second, &reply, NULL)); /* whatever this returns, the message is gone */
    printf("%.*s\n", (int)reply.length, (const char *)reply.bytes);
    check(sinew_settle_message(endpoint, &reply, SINEW_DELIVERED));
    check(sinew_unregister(&endpoint));
    return EXIT_SUCCESS;
}
