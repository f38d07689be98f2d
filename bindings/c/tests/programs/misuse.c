/* Misuses the API in every way, and checks that each call is rejected with a sentence that gives the reason. */
#define _POSIX_C_SOURCE 200809L

#include <sinew.h>

#include <pthread.h>
#include <sched.h>
#include <stdio.h>
#include <stdlib.h>
#include <sys/wait.h>
#include <unistd.h>

#define SECOND UINT64_C(1000000000)
#define EXPECT(status, wanted) expect(__LINE__, #status, (status), (wanted), "")
#define EXPECT_WORDS(status, wanted, words) expect(__LINE__, #status, (status), (wanted), (words))

static void expect(int line, const char *what, int got, int wanted, const char *words)
{
    if (got == wanted && strstr(sinew_last_error(), words))
        return;
    printf("line %d: %s is %d (%s), not %d; '%s' should say '%s'\n", line, what, got, sinew_status_text(got), wanted,
           sinew_last_error(), words);
    exit(EXIT_FAILURE);
}

static sinew_text node;
static sinew_kind kind;
static const uint32_t own_abi = SINEW_ABI;
static const sinew_payload_type stop_type = SINEW_PAYLOAD_EMPTY("test.stop", SINEW_CONTROL);
static const sinew_field number_fields[] = { { "number", 0, sizeof(uint32_t), 0, NULL, SINEW_TYPE_U32, 0 } };
static const sinew_payload_type number_type = SINEW_PAYLOAD("test.number", SINEW_CONTROL, uint32_t, number_fields);

static sinew_endpoint *new_endpoint(void)
{
    sinew_endpoint *endpoint = NULL;
    EXPECT(sinew_register_transport_address(node, NULL, &endpoint), SINEW_OK);
    return endpoint;
}

static sinew_message new_message(sinew_endpoint *endpoint, sinew_tid to, size_t length)
{
    sinew_message message;
    EXPECT(sinew_create_message(endpoint, to, kind, SINEW_CONTROL, length, &message), SINEW_OK);
    return message;
}

static void null_arguments(sinew_endpoint *endpoint)
{
    sinew_message message = new_message(endpoint, 1, 1);
    sinew_received received;
    sinew_tid tid;
    sinew_endpoint *no_endpoint = NULL;
    sinew_text no_text = { NULL, 3 };
    char long_path[200];
    memset(long_path, 'x', sizeof long_path - 1);
    long_path[sizeof long_path - 1] = 0;
    EXPECT_WORDS(sinew_register_transport_address(node, NULL, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`endpoint` is NULL");
    EXPECT_WORDS(sinew_register_transport_address(no_text, NULL, &endpoint), SINEW_ERROR_INVALID_ARGUMENT, "`socket`");
    EXPECT_WORDS(sinew_register_transport_address(sinew_text_of(""), NULL, &no_endpoint), SINEW_ERROR_INVALID_ARGUMENT, "is empty");
    EXPECT_WORDS(sinew_register_transport_address(sinew_text_of(long_path), NULL, &no_endpoint), SINEW_ERROR_INVALID_ARGUMENT, "107");
    EXPECT_WORDS(sinew_unregister(NULL), SINEW_ERROR_NO_SUCH_ENDPOINT, "is it NULL");
    EXPECT_WORDS(sinew_unregister(&no_endpoint), SINEW_ERROR_NO_SUCH_ENDPOINT, "is it NULL");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, kind, 0, 1, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`message` is NULL");
    EXPECT_WORDS(sinew_create_message(NULL, 1, kind, 0, 1, &message), SINEW_ERROR_NO_SUCH_ENDPOINT, "is it NULL");
    EXPECT_WORDS(sinew_send_message(endpoint, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`message` is NULL");
    EXPECT_WORDS(sinew_room_within(endpoint, NULL, 0), SINEW_ERROR_INVALID_ARGUMENT, "`message` is NULL");
    EXPECT(sinew_discard_message(endpoint, &message), SINEW_OK);
    EXPECT_WORDS(sinew_send_bytes(endpoint, 1, kind, 0, NULL, 5), SINEW_ERROR_INVALID_ARGUMENT, "`bytes` is NULL");
    EXPECT_WORDS(sinew_receive_message(endpoint, 0, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`received` is NULL");
    EXPECT_WORDS(sinew_receive_message(NULL, 0, &received), SINEW_ERROR_NO_SUCH_ENDPOINT, "is it NULL");
    EXPECT_WORDS(sinew_next_undelivered(endpoint, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`undelivered` is NULL");
    EXPECT_WORDS(sinew_settle_message(endpoint, NULL, 0), SINEW_ERROR_INVALID_ARGUMENT, "`received` is NULL");
    EXPECT_WORDS(sinew_resolve(endpoint, no_text, 1, &tid), SINEW_ERROR_INVALID_ARGUMENT, "`name` is NULL");
    EXPECT_WORDS(sinew_resolve(endpoint, node, 1, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`tid` is NULL");
    EXPECT_WORDS(sinew_join_group(NULL, node), SINEW_ERROR_NO_SUCH_ENDPOINT, "is it NULL");
    EXPECT_WORDS(sinew_tid_text(1, NULL, 9), SINEW_ERROR_INVALID_ARGUMENT, "`text` is NULL");
    EXPECT(sinew_endpoint_tid(NULL) == 0, 1);
    EXPECT(sinew_payload_max(NULL) == 0, 1);
    EXPECT(sinew_node_name(NULL) == NULL, 1);
}

/* Each of the functions that send, with the current kind of misuse. */
static sinew_status send_anyhow(int how, sinew_endpoint *endpoint, const sinew_received *request, sinew_message *message)
{
    sinew_received reply;
    sinew_outcome outcome;
    switch (how) {
    case 0: return sinew_send_message(endpoint, message);
    case 1: return sinew_send_message_confirmed(endpoint, message, SECOND, &outcome);
    case 2: return sinew_ask(endpoint, message, SECOND, &reply, &outcome);
    default: return sinew_reply(endpoint, request, message);
    }
}

/* A message that was passed in is gone with every result: nothing is kept, and the next one can be created. */
static void gone(sinew_endpoint *endpoint, const sinew_message *message)
{
    sinew_message next;
    EXPECT(message->bytes == NULL && message->length == 0 && message->token == 0, 1);
    next = new_message(endpoint, 1, 1);
    EXPECT(sinew_discard_message(endpoint, &next), SINEW_OK);
}

static void whose_it_is_after_an_error(sinew_endpoint *endpoint)
{
    static sinew_received in_hand[1024];
    sinew_tid own = sinew_endpoint_tid(endpoint);
    sinew_received reply, none;
    sinew_outcome outcome;
    sinew_message message, other;
    memset(&none, 0, sizeof none);
    message = new_message(endpoint, own, 100);
    EXPECT_WORDS(sinew_send_message_confirmed(endpoint, &message, 1, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`outcome`");
    gone(endpoint, &message);
    message = new_message(endpoint, own, 100);
    EXPECT_WORDS(sinew_ask(endpoint, &message, 1, NULL, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`reply` is NULL");
    gone(endpoint, &message);
    message = new_message(endpoint, own, 100);
    EXPECT_WORDS(sinew_reply(endpoint, NULL, &message), SINEW_ERROR_INVALID_ARGUMENT, "`request` is NULL");
    gone(endpoint, &message);
    message = new_message(endpoint, own, 100);
    EXPECT_WORDS(sinew_reply(endpoint, &none, &message), SINEW_ERROR_NO_SUCH_MESSAGE, "the request");
    gone(endpoint, &message);
    /* It is gone already. */
    for (int how = 0; how < 4; how++) {
        memset(&other, 0, sizeof other);
        EXPECT_WORDS(send_anyhow(how, endpoint, &none, &other), SINEW_ERROR_NO_SUCH_MESSAGE, "the message");
    }
    /* The message is not looked at. */
    message = other = new_message(endpoint, own, 100);
    for (int how = 0; how < 4; how++) {
        EXPECT(send_anyhow(how, NULL, &none, &message), SINEW_ERROR_NO_SUCH_ENDPOINT);
        EXPECT(memcmp(&message, &other, sizeof message), 0);
    }
    EXPECT(sinew_discard_message(endpoint, &message), SINEW_OK);
    /* No application answers. */
    message = new_message(endpoint, own, 100);
    EXPECT(sinew_send_message_confirmed(endpoint, &message, 1, &outcome), SINEW_OK);
    EXPECT(outcome == SINEW_UNKNOWN || outcome == SINEW_EXPIRED, 1);
    gone(endpoint, &message);
    while (sinew_receive_message(endpoint, SECOND / 100, &reply) == SINEW_OK)
        EXPECT(sinew_settle_message(endpoint, &reply, SINEW_DELIVERED), SINEW_OK);
    /* Too many unsettled messages. */
    for (int held = 0; held < 1024; held++) {
        EXPECT(sinew_send_bytes(endpoint, own, kind, SINEW_CONTROL, NULL, 0), SINEW_OK);
        EXPECT(sinew_receive_message(endpoint, 10 * SECOND, &in_hand[held]), SINEW_OK);
    }
    EXPECT_WORDS(sinew_receive_message(endpoint, 0, &reply), SINEW_ERROR_TOO_MANY, "settle");
    message = new_message(endpoint, own, 100);
    EXPECT_WORDS(sinew_ask(endpoint, &message, SECOND, &reply, &outcome), SINEW_ERROR_TOO_MANY, "settle");
    gone(endpoint, &message);
    for (int held = 0; held < 1024; held++)
        EXPECT(sinew_settle_message(endpoint, &in_hand[held], SINEW_DELIVERED), SINEW_OK);
}

/* A value may be NULL where its type has no fields, and nowhere else. */
static void no_value(sinew_endpoint *endpoint)
{
    sinew_message message;
    uint8_t bytes[8];
    size_t length = 0;
    EXPECT_WORDS(sinew_create_value(endpoint, 1, &number_type, NULL, &message), SINEW_ERROR_INVALID_ARGUMENT, "`value` is NULL");
    EXPECT_WORDS(sinew_decode_value(&number_type, bytes, 0, NULL), SINEW_ERROR_INVALID_ARGUMENT, "`value` is NULL");
    EXPECT(sinew_encode_value(&stop_type, NULL, bytes, sizeof bytes, &length), SINEW_OK);
    EXPECT(length == 1 && bytes[0] == 0x90, 1);
    EXPECT(sinew_decode_value(&stop_type, bytes, length, NULL), SINEW_OK);
    EXPECT(sinew_decode_value(&stop_type, NULL, 0, NULL), SINEW_OK);
    bytes[0] = 0xc1;
    EXPECT_WORDS(sinew_decode_value(&stop_type, bytes, 1, NULL), SINEW_ERROR_MALFORMED, "this is no test.stop: expected a struct, found the byte 0xc1");
}

static void wrong_values(sinew_endpoint *endpoint)
{
    sinew_message message;
    sinew_endpoint *other;
    sinew_tid tid;
    char text[8];
    sinew_text latin1 = { "kn\xf6" "chel", 7 };
    sinew_options options = { .size = 0 };
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &other), SINEW_ERROR_INVALID_ARGUMENT, "sizeof");
    options.size = sizeof options;
    options.name = latin1;
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &other), SINEW_ERROR_INVALID_ARGUMENT, "UTF-8");
    EXPECT_WORDS(sinew_register_transport_address(SINEW_TEXT("/nowhere/knee.sock"), NULL, &other), SINEW_ERROR_NO_NODE,
                 "\"/nowhere/knee.sock\"");
    options.name = SINEW_TEXT("line\nbreak");
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &other), SINEW_ERROR_REFUSED, "the node refused");
    options.name = SINEW_TEXT("waits");
    options.required = &node;
    options.required_count = 1;
    options.deadline_ns = 1000000000;
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &other), SINEW_ERROR_WAITING, "still waiting for");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, kind, 3, 1, &message), SINEW_ERROR_INVALID_ARGUMENT, "`message_class`");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, kind, -1, 1, &message), SINEW_ERROR_INVALID_ARGUMENT, "`message_class`");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, 0, 0, 1, &message), SINEW_ERROR_INVALID_ARGUMENT, "sinew_kind_named");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, 7, 0, 1, &message), SINEW_ERROR_INVALID_ARGUMENT, "sinew_kind_named");
    EXPECT_WORDS(sinew_create_message(endpoint, 1, kind, 0, sinew_payload_max(endpoint) + 1, &message),
                 SINEW_ERROR_TOO_LONG, "65536");
    memset(&options, 0, sizeof options);
    options.size = sizeof options;
    options.reserved = 1;
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &other), SINEW_ERROR_INVALID_ARGUMENT, "`options.reserved` is 1");
    EXPECT_WORDS(sinew_tid_parse(SINEW_TEXT("knee"), &tid), SINEW_ERROR_INVALID_ARGUMENT, "node/application");
    EXPECT_WORDS(sinew_tid_text(1, text, 3), SINEW_ERROR_INVALID_ARGUMENT, "`capacity`");
    EXPECT(sinew_tid_parse(SINEW_TEXT("10.0.0.7/1001"), &tid), SINEW_OK);
    EXPECT(tid == UINT64_C(0x0a00000700001001), 1);
    EXPECT(sinew_resolve(endpoint, SINEW_TEXT("nobody"), SECOND, &tid), SINEW_NOTHING);
    EXPECT(tid == 0, 1);
}

/* A message can be sent, discarded or settled once; a message of another endpoint is rejected. */
static void used_twice(sinew_endpoint *endpoint)
{
    sinew_endpoint *other = new_endpoint();
    sinew_message message = new_message(endpoint, sinew_endpoint_tid(endpoint), 1), copy = message;
    sinew_received received, received_copy, reply;
    sinew_outcome outcome = SINEW_UNKNOWN;
    EXPECT(sinew_send_message(other, &message), SINEW_ERROR_NO_SUCH_MESSAGE);
    EXPECT(sinew_send_message(endpoint, &message), SINEW_OK);
    EXPECT(message.bytes == NULL && message.token == 0, 1);
    EXPECT_WORDS(sinew_send_message(endpoint, &message), SINEW_ERROR_NO_SUCH_MESSAGE, "sent");
    EXPECT(sinew_send_message(endpoint, &copy), SINEW_ERROR_NO_SUCH_MESSAGE);
    EXPECT(sinew_discard_message(endpoint, &copy), SINEW_ERROR_NO_SUCH_MESSAGE);
    EXPECT(sinew_receive_message(endpoint, 10 * SECOND, &received), SINEW_OK);
    received_copy = received;
    message = new_message(endpoint, received.source, 1);
    EXPECT(sinew_reply(endpoint, &received, &message), SINEW_ERROR_NOT_ASKED);
    EXPECT_WORDS(sinew_settle_message(endpoint, &received, 99), SINEW_ERROR_INVALID_ARGUMENT, "`outcome`");
    EXPECT(sinew_settle_message(endpoint, &received, SINEW_DELIVERED), SINEW_OK);
    EXPECT(sinew_settle_message(endpoint, &received_copy, SINEW_DELIVERED), SINEW_ERROR_NO_SUCH_MESSAGE);
    message = new_message(endpoint, UINT64_C(0x7777), 1);
    EXPECT_WORDS(sinew_ask(endpoint, &message, SECOND, &reply, &outcome), SINEW_ERROR_NOT_HANDLED, "no application has this TID");
    EXPECT(outcome, SINEW_REJECTED_NO_SUCH_APPLICATION);
    EXPECT(sinew_unregister(&other), SINEW_OK);
}

static void have_in_hand(sinew_endpoint *endpoint, sinew_received *received)
{
    EXPECT(sinew_send_bytes(endpoint, sinew_endpoint_tid(endpoint), kind, SINEW_CONTROL, NULL, 0), SINEW_OK);
    EXPECT(sinew_receive_message(endpoint, 10 * SECOND, received), SINEW_OK);
}

/* A token of one endpoint is not valid for another one, even with the same index, at any time. */
static void in_another_hand(sinew_endpoint *endpoint)
{
    sinew_endpoint *other = new_endpoint();
    sinew_message mine = new_message(endpoint, sinew_endpoint_tid(other), 1), theirs = new_message(other, sinew_endpoint_tid(other), 1);
    sinew_received here, there, later;
    mine.bytes[0] = 1;
    theirs.bytes[0] = 2;
    EXPECT(sinew_send_message(other, &mine), SINEW_ERROR_NO_SUCH_MESSAGE);
    EXPECT(sinew_send_message(endpoint, &mine), SINEW_OK);
    EXPECT(sinew_discard_message(other, &theirs), SINEW_OK);
    EXPECT(sinew_receive_message(other, 10 * SECOND, &there), SINEW_OK);
    EXPECT(there.bytes[0], 1);
    have_in_hand(endpoint, &here);
    EXPECT(sinew_settle_message(other, &here, SINEW_DELIVERED), SINEW_ERROR_NO_SUCH_MESSAGE);
    theirs = new_message(other, here.source, 1);
    EXPECT_WORDS(sinew_reply(other, &here, &theirs), SINEW_ERROR_NO_SUCH_MESSAGE, "the request");
    EXPECT(sinew_settle_message(endpoint, &here, SINEW_DELIVERED), SINEW_OK);
    EXPECT(sinew_unregister(&other), SINEW_OK);
    other = new_endpoint();
    have_in_hand(other, &later);
    EXPECT(sinew_settle_message(other, &there, SINEW_DELIVERED), SINEW_ERROR_NO_SUCH_MESSAGE);
    EXPECT(sinew_settle_message(other, &later, SINEW_DELIVERED), SINEW_OK);
    EXPECT(sinew_unregister(&other), SINEW_OK);
}

/* One message is on loan at a time, over every transport, and nothing else is sent before it. */
static void one_at_a_time(const char *way, uint32_t links)
{
    sinew_options options = { .size = sizeof options, .links = links };
    sinew_endpoint *endpoint = NULL;
    sinew_received received;
    sinew_message first, second;
    sinew_tid to, tid;
    EXPECT_WORDS(sinew_register_transport_address(node, &options, &endpoint), SINEW_OK, "");
    to = sinew_endpoint_tid(endpoint);
    for (size_t length = 5; length <= 50000; length += 49995) {
        first = new_message(endpoint, to, length);
        memcpy(first.bytes, "first", 5);
        EXPECT_WORDS(sinew_create_message(endpoint, to, kind, 0, 1, &second), SINEW_ERROR_LOAN_ACTIVE, "pass it to sinew_send_message or sinew_discard_message first");
        EXPECT_WORDS(sinew_send_bytes(endpoint, to, kind, SINEW_CONTROL, NULL, 0), SINEW_ERROR_LOAN_ACTIVE, "on loan");
        EXPECT(sinew_resolve(endpoint, SINEW_TEXT("nobody"), SECOND, &tid), SINEW_ERROR_LOAN_ACTIVE);
        EXPECT(sinew_join_group(endpoint, SINEW_TEXT("drives")), SINEW_ERROR_LOAN_ACTIVE);
        EXPECT(sinew_leave_group(endpoint, SINEW_TEXT("drives")), SINEW_ERROR_LOAN_ACTIVE);
        EXPECT(sinew_receive_message(endpoint, 0, &received), SINEW_NOTHING);
        EXPECT(sinew_send_message(endpoint, &first), SINEW_OK);
        EXPECT(sinew_receive_message(endpoint, 10 * SECOND, &received), SINEW_OK);
        EXPECT(received.length == length && memcmp(received.bytes, "first", 5) == 0, 1);
        EXPECT(sinew_settle_message(endpoint, &received, SINEW_DELIVERED), SINEW_OK);
        first = new_message(endpoint, to, length);
        EXPECT(sinew_discard_message(endpoint, &first), SINEW_OK);
        EXPECT(sinew_send_bytes(endpoint, to, kind, SINEW_CONTROL, "second", 6), SINEW_OK);
        EXPECT(sinew_receive_message(endpoint, 10 * SECOND, &received), SINEW_OK);
        EXPECT(received.length == 6 && memcmp(received.bytes, "second", 6) == 0, 1);
        EXPECT(sinew_settle_message(endpoint, &received, SINEW_DELIVERED), SINEW_OK);
    }
    /* A message that is not sent goes with the endpoint. */
    (void)new_message(endpoint, to, 100);
    EXPECT(sinew_unregister(&endpoint), SINEW_OK);
    printf("one at a time by %s\n", way);
}

static void unregistered(void)
{
    sinew_endpoint *endpoint = new_endpoint(), *copy = endpoint;
    sinew_message message;
    sinew_endpoint *garbage = (sinew_endpoint *)(void *)&message;
    EXPECT(sinew_unregister(&endpoint), SINEW_OK);
    EXPECT(endpoint == NULL, 1);
    EXPECT_WORDS(sinew_unregister(&copy), SINEW_ERROR_NO_SUCH_ENDPOINT, "unregistered");
    EXPECT(sinew_receive_message(copy, 0, NULL), SINEW_ERROR_INVALID_ARGUMENT);
    EXPECT(sinew_create_message(copy, 1, kind, 0, 1, &message), SINEW_ERROR_NO_SUCH_ENDPOINT);
    EXPECT(sinew_create_message(garbage, 1, kind, 0, 1, &message), SINEW_ERROR_NO_SUCH_ENDPOINT);
}

/* Waits for one message, as soon as the endpoint is free for it. */
static void *receive_one(void *endpoint)
{
    sinew_received received;
    sinew_status status;
    while ((status = sinew_receive_message(endpoint, 20 * SECOND, &received)) == SINEW_ERROR_BUSY)
        sched_yield();
    EXPECT(status, SINEW_OK);
    EXPECT(sinew_settle_message(endpoint, &received, SINEW_DELIVERED), SINEW_OK);
    return NULL;
}

static void two_threads(sinew_endpoint *endpoint)
{
    sinew_endpoint *shared = new_endpoint(), *still = shared;
    sinew_tid to = sinew_endpoint_tid(shared);
    sinew_message message;
    sinew_status status;
    pthread_t thread;
    if (pthread_create(&thread, NULL, receive_one, shared) != 0)
        exit(EXIT_FAILURE);
    /* Until the thread is in its call, ours succeed; a message that cannot be discarded goes with the endpoint.
       Yields after each: if one thread runs at a time, as under valgrind, it would else be stopped inside its own call
       again and again, and the thread would get BUSY without end. */
    while ((status = sinew_create_message(shared, to, kind, 0, 1, &message)) == SINEW_OK) {
        (void)sinew_discard_message(shared, &message);
        sched_yield();
    }
    EXPECT_WORDS(status, SINEW_ERROR_BUSY, "one endpoint for each thread");
    EXPECT(sinew_unregister(&still), SINEW_ERROR_BUSY);
    EXPECT(still == shared, 1);
    EXPECT(sinew_send_bytes(endpoint, to, kind, SINEW_CONTROL, NULL, 0), SINEW_OK);
    pthread_join(thread, NULL);
    EXPECT(sinew_unregister(&shared), SINEW_OK);
}

/* The child has the same memory and the same connection, and may use neither. */
static void forked(sinew_endpoint *endpoint)
{
    int status = -1;
    pid_t child;
    fflush(stdout);
    child = fork();
    if (child == 0) {
        sinew_endpoint *copy = endpoint;
        sinew_message message;
        EXPECT_WORDS(sinew_create_message(endpoint, 1, kind, 0, 1, &message), SINEW_ERROR_FORKED, "forked");
        EXPECT(sinew_unregister(&copy), SINEW_ERROR_FORKED);
        copy = new_endpoint();
        EXPECT(sinew_unregister(&copy), SINEW_OK);
        fflush(stdout);
        _exit(0);
    }
    waitpid(child, &status, 0);
    EXPECT(status, 0);
    EXPECT(sinew_send_bytes(endpoint, 1, kind, SINEW_CONTROL, NULL, 0), SINEW_OK);
}

/* From here on this is a program that was compiled with the header of another library. */
#undef SINEW_ABI
#define SINEW_ABI 1000
static void compiled_with_another_header(void)
{
    sinew_endpoint *endpoint = NULL;
    EXPECT_WORDS(sinew_register_transport_address(node, NULL, &endpoint), SINEW_ERROR_INVALID_ARGUMENT,
                 "compiled with a sinew.h of SINEW_ABI 1000, and this library has SINEW_ABI 1;");
    EXPECT(endpoint == NULL, 1);
}

int main(int argc, char **argv)
{
    sinew_endpoint *endpoint;
    if (argc < 2 || sinew_abi() != own_abi)
        return EXIT_FAILURE;
    node = sinew_text_of(argv[1]);
    kind = sinew_kind_named(SINEW_TEXT("test.misuse"));
    endpoint = new_endpoint();
    compiled_with_another_header();
    null_arguments(endpoint);
    no_value(endpoint);
    wrong_values(endpoint);
    used_twice(endpoint);
    in_another_hand(endpoint);
    whose_it_is_after_an_error(endpoint);
    one_at_a_time("rings", 0);
    one_at_a_time("direct links", SINEW_DIRECT_ALWAYS);
    one_at_a_time("the socket", SINEW_SOCKET_ONLY);
    unregistered();
    two_threads(endpoint);
    forked(endpoint);
    EXPECT(sinew_unregister(&endpoint), SINEW_OK);
    printf("all refused\n");
    return EXIT_SUCCESS;
}
