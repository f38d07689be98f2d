// What sinew.hpp adds to sinew.h: ends of scopes, exceptions, moves.
#include <sinew.hpp>

#include <cstdio>
#include <cstdlib>
#include <thread>

using namespace std::chrono_literals;

#define EXPECT(claim) \
    do { \
        if (!(claim)) { \
            std::printf("line %d: not so: %s\n", __LINE__, #claim); \
            std::exit(1); \
        } \
    } while (false)

struct pair { std::int32_t a, b; };

static const auto what = sinew::kind_named("test.wrapper");

static void errors_are_exceptions(sinew::endpoint &endpoint)
{
    try {
        sinew::endpoint nowhere("/nowhere/knee.sock");
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_NO_NODE);
        EXPECT(std::string(error.what()).find("/nowhere/knee.sock") != std::string::npos);
    }
    try {
        (void)endpoint.create(1, what, endpoint.payload_max() + 1);
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_TOO_LONG);
    }
    EXPECT(!endpoint.receive(0ns));
    EXPECT(!endpoint.resolve("nobody", 10s));
    EXPECT(endpoint.confirm(0x7777, what, pair{1, 2}, 10s) == SINEW_REJECTED_NO_SUCH_APPLICATION);
}

// What was sent without asking and reached nobody is said with its number.
static void untaken_messages_are_counted(sinew::endpoint &endpoint)
{
    EXPECT(!endpoint.untaken());
    for (int number = 0; number < 3; number++)
        endpoint.send(0x7777, what, pair{1, 2});
    std::uint64_t count = 0;
    for (int look = 0; look < 1000 && count < 3; look++) {
        while (const auto untaken = endpoint.untaken()) {
            EXPECT((untaken->destination & 0xffffffff) == 0x7777 && untaken->since_ns <= sinew_now_ns());
            EXPECT(untaken->outcome == SINEW_REJECTED_NO_SUCH_APPLICATION);
            count += untaken->count;
        }
        EXPECT(!endpoint.receive(10ms));
    }
    EXPECT(count == 3);
}

// How the receiver ends with the message in hand decides what its sender is told.
static void scopes_settle(sinew::endpoint &sender, sinew::endpoint receiver)
{
    const sinew::tid to = receiver.address();
    std::thread receiving([receiver = std::move(receiver)]() mutable {
        {
            auto message = receiver.receive(20s);
            EXPECT(message && message->as<pair>() && message->as<pair>()->b == 2 && !message->as<char>());
            EXPECT(message->age_error() == 0ns && message->age_at_most() < sinew::duration::max());
            EXPECT(message->age() >= 0ns && message->end() - message->begin() == sizeof(pair));
        }
        try {
            auto message = receiver.receive(20s);
            throw std::runtime_error("the handler fails");
        } catch (const std::runtime_error &) {
        }
        receiver.receive(20s)->settle(SINEW_REJECTED_BY_HANDLER);
        auto request = receiver.receive(20s);
        auto kept = std::move(*request);
        receiver.reply(kept, what, pair{kept.as<pair>()->b, kept.as<pair>()->a});
    });
    EXPECT(sender.confirm(to, what, pair{1, 2}, 20s) == SINEW_DELIVERED);
    EXPECT(sender.confirm(to, what, pair{1, 2}, 20s) == SINEW_FAILED);
    EXPECT(sender.confirm(to, what, pair{1, 2}, 20s) == SINEW_REJECTED_BY_HANDLER);
    const auto reply = sender.ask(to, what, pair{1, 2}, 20s);
    EXPECT(reply.as<pair>()->a == 2 && reply.source() == to);
    receiving.join();
}

// One is lent at a time: it is given back at the end of its scope.
static void unsent_messages_are_given_back(sinew::endpoint &endpoint)
{
    for (int made = 0; made < 1000; made++) {
        auto message = endpoint.create(endpoint.address(), what, 9, SINEW_BULK);
        EXPECT(message.end() - message.begin() == 9);
        try {
            auto another = endpoint.create(endpoint.address(), what, 8);
            EXPECT(false);
        } catch (const sinew::error &error) {
            EXPECT(error.status() == SINEW_ERROR_LENT);
        }
    }
}

// No room in time is of a control loop's ordinary course: it throws nothing.
static void sends_may_have_a_time(sinew::endpoint &endpoint)
{
    EXPECT(endpoint.send_within(endpoint.address(), what, pair{5, 6}, 0ns));
    EXPECT(endpoint.receive(20s)->as<pair>()->a == 5);
    EXPECT(endpoint.send_within(endpoint.create(endpoint.address(), what, 3), 1ms));
    EXPECT(endpoint.receive(20s)->size() == 3);
}

static void groups_and_names(const char *socket)
{
    sinew::options options;
    options.name = "member";
    options.handled = {"test.wrapper"};
    options.links = SINEW_SOCKET_ONLY;
    sinew::endpoint member(socket, options), sender(socket);
    EXPECT(sender.resolve("member", 10s) == member.address());
    EXPECT(member.node_name() == "knee");
    member.join("drives");
    sender.send(sinew::group("drives"), what, pair{3, 4});
    EXPECT(member.receive(20s)->destination() == sinew::group("drives"));
    member.leave("drives");
    member.unregister();
    EXPECT(!sender.resolve("member", 10s));
    EXPECT(member.address() == 0);
}

int main(int argc, char **argv)
{
    const char *socket = argc > 1 ? argv[1] : "";
    sinew::endpoint endpoint(socket);
    errors_are_exceptions(endpoint);
    untaken_messages_are_counted(endpoint);
    scopes_settle(endpoint, sinew::endpoint(socket));
    unsent_messages_are_given_back(endpoint);
    sends_may_have_a_time(endpoint);
    groups_and_names(socket);
    std::puts("all well");
}
