// The additions of sinew.hpp to sinew.h: scopes, exceptions, moves.
#include <sinew.hpp>

#include <atomic>
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

enum class mode : std::uint8_t { idle = 1, walking = 2 };
struct gain { double p, d; };
SINEW_STRUCT(gain, p, d)
struct setpoint { float torque; std::int64_t number; bool is_armed; mode state; char label[8]; std::array<std::uint16_t, 3> steps; gain gains[2]; };
SINEW_PAYLOAD(setpoint, "test.setpoint", SINEW_STREAM, torque, number, is_armed, state, label, steps, gains)
struct narrow { std::uint8_t number; };
SINEW_PAYLOAD(narrow, "test.setpoint", SINEW_STREAM, number)
struct other { float torque; };
SINEW_PAYLOAD(other, "test.other", SINEW_CONTROL, torque)
struct brief { float torque; };
SINEW_PAYLOAD_EXPIRING(brief, "test.brief", SINEW_CONTROL, 1us, torque)
struct stop {};
SINEW_PAYLOAD(stop, "test.stop", SINEW_CONTROL)
struct brief_stop {};
SINEW_PAYLOAD_EXPIRING(brief_stop, "test.brief_stop", SINEW_CONTROL, 1us)
struct idle {};
SINEW_STRUCT(idle)
struct report { idle state; float torque; stop stops[2]; };
SINEW_PAYLOAD(report, "test.report", SINEW_CONTROL, state, torque, stops)

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

// Unconfirmed messages that were not delivered are reported with their number.
static void undelivered_messages_are_counted(sinew::endpoint &endpoint)
{
    EXPECT(!endpoint.take_undelivered());
    for (int number = 0; number < 3; number++)
        endpoint.send(0x7777, what, pair{1, 2});
    std::uint64_t count = 0;
    for (int look = 0; look < 1000 && count < 3; look++) {
        while (const auto undelivered = endpoint.take_undelivered()) {
            EXPECT((undelivered->destination & 0xffffffff) == 0x7777 && undelivered->since_ns <= sinew_now_ns());
            EXPECT(undelivered->outcome == SINEW_REJECTED_NO_SUCH_APPLICATION);
            EXPECT(undelivered->kind == what && undelivered->message_class == SINEW_CONTROL);
            count += undelivered->count;
        }
        EXPECT(!endpoint.receive(10ms));
    }
    EXPECT(count == 3);
}

// A described struct arrives as it was sent; one of another kind gives none; a mismatch is an error with the
// field's name.
static void values_are_typed(sinew::endpoint &endpoint)
{
    const setpoint sent{2.5f, -7, true, mode::walking, "knee", {1, 2, 3}, {{1.0, 0.5}, {2.0, 0.25}}};
    endpoint.send(endpoint.address(), sent);
    auto message = endpoint.receive(20s);
    EXPECT(message && !message->as<other>());
    const auto got = message->as<setpoint>();
    EXPECT(got && got->torque == 2.5f && got->number == -7 && got->is_armed && got->state == mode::walking);
    EXPECT(std::string(got->label) == "knee" && got->steps[2] == 3 && got->gains[1].d == 0.25);
    try {
        (void)message->as<narrow>();
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_MALFORMED);
        EXPECT(std::string(error.what()).find("field `number`: expected uint8_t, found the integer -7") != std::string::npos);
    }
    EXPECT(endpoint.confirm(endpoint.create(0x7777, other{1.0f}), 10s) == SINEW_REJECTED_NO_SUCH_APPLICATION);
}

// A struct without fields is a payload, and may be a field of another.
static void types_without_fields(sinew::endpoint &endpoint)
{
    const sinew::tid own = endpoint.address();
    endpoint.send(own, brief_stop{});
    std::this_thread::sleep_for(1ms);
    EXPECT(!endpoint.receive(0ns));
    endpoint.send(own, stop{});
    auto message = endpoint.receive(20s);
    EXPECT(message && message->as<stop>() && !message->as<other>() && message->size() == 1);
    endpoint.send(own, report{{}, 2.5f, {}});
    EXPECT(endpoint.receive(20s)->as<report>()->torque == 2.5f);
    endpoint.send(endpoint.create(own, sinew::kind_named("test.stop"), 0));
    EXPECT(endpoint.receive(20s)->as<stop>());
}

// A message that is older than its type, or its send, allows is not received.
static void old_messages_expire(sinew::endpoint &endpoint)
{
    const sinew::tid own = endpoint.address();
    endpoint.send(own, brief{1.0f});
    endpoint.send(endpoint.create(own, other{2.0f}).expires_after(1us));
    std::this_thread::sleep_for(1ms);
    EXPECT(!endpoint.receive(0ns));
    endpoint.send(endpoint.create(own, brief{3.0f}).expires_after(1h));
    endpoint.send(own, other{4.0f});
    EXPECT(endpoint.receive(20s)->as<brief>()->torque == 3.0f);
    EXPECT(endpoint.receive(20s)->as<other>()->torque == 4.0f);
    try {
        endpoint.send(endpoint.create(own, other{5.0f}).expires_after(0ns));
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_INVALID_ARGUMENT);
    }
}

// The way in which the receiver destroys a message decides the outcome that its sender gets.
static void scopes_settle(sinew::endpoint &sender, sinew::endpoint receiver)
{
    const sinew::tid to = receiver.address();
    std::thread receiving([receiver = std::move(receiver)]() mutable {
        {
            auto message = receiver.receive(20s);
            EXPECT(message && message->as<pair>() && message->as<pair>()->b == 2 && !message->as<char>());
            EXPECT(message->age_error() == 0ns && message->age_at_most() >= message->age_error());
            EXPECT(message->age() >= 0ns && !message->is_older_than(1h) && message->end() - message->begin() == sizeof(pair));
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

// One message is on loan at a time: the end of its scope discards it.
static void unsent_messages_are_given_back(sinew::endpoint &endpoint)
{
    for (int made = 0; made < 1000; made++) {
        auto message = endpoint.create(endpoint.address(), what, 9, SINEW_BULK);
        EXPECT(message.end() - message.begin() == 9);
        try {
            auto another = endpoint.create(endpoint.address(), what, 8);
            EXPECT(false);
        } catch (const sinew::error &error) {
            EXPECT(error.status() == SINEW_ERROR_LOAN_ACTIVE);
        }
    }
}

// No room in time is normal in a control loop: it throws nothing.
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
    try {
        (void)sender.confirm(sinew::group("drives"), what, pair{3, 4}, 20s);
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_INVALID_ARGUMENT);
        EXPECT(std::string(error.what()).find("sinew_send_message_confirmed_by_each") != std::string::npos);
    }
    std::thread taking([&] { EXPECT(member.receive(20s)); });
    const auto told = sender.confirm_by_each(sinew::group("drives"), what, pair{3, 4}, 20s);
    taking.join();
    EXPECT(told.size() == 1 && told[0].tid == member.address() && told[0].outcome == SINEW_DELIVERED);
    member.leave("drives");
    EXPECT(sender.confirm_by_each(sinew::group("drives"), what, pair{3, 4}, 20s).empty());
    member.unregister();
    EXPECT(!sender.resolve("member", 10s));
    EXPECT(member.address() == 0);
}

// Sends good messages until the first of them has passed a guard that is live.
static std::optional<pair> come_alive(sinew::endpoint &sender, sinew::endpoint &receiver, const sinew_protected_type &type,
                                      sinew::guard<int> &guard)
{
    std::optional<pair> came;
    for (int look = 0; look < 2000 && !came; look++) {
        sender.send_protected(receiver.address(), type, pair{1, look});
        while (sender.receive(0ns)) {
        }
        if (guard.state() != SINEW_LIVE)
            (void)guard.arm();
        if (auto message = receiver.receive(10ms))
            came = message->as<pair>();
    }
    return came;
}

// Whether the guard is tripped; an output that is not known to be safe is an exception.
static bool is_tripped(const sinew::guard<int> &guard)
{
    try {
        return guard.state() == SINEW_SAFE_TRIPPED;
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_SAFE_FAILS);
        return false;
    }
}

// A guard releases its output when another guard is assigned to it.
static void guards_are_assigned(sinew::endpoint &receiver, sinew::tid source)
{
    const auto one = sinew::protected_type<pair>("test.wrapper_one", 20s);
    const auto other = sinew::protected_type<pair>("test.wrapper_other", 20s);
    const auto safe = [](int &output, sinew_output_state) { output = 0; };
    auto guard = receiver.guard(source, one, 7, safe);
    auto second = receiver.guard(source, other, 7, safe);
    guard = std::move(second);
    EXPECT(guard.state() == SINEW_SAFE_NOT_ARMED);
    second = receiver.guard(source, one, 7, safe); // Rejected while that is guarded.
    EXPECT(second.state() == SINEW_SAFE_NOT_ARMED);
    try {
        (void)receiver.guard(source, sinew::protected_type<pair>("test.wrapper_empty", 20s), 7, {});
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_INVALID_ARGUMENT);
    }
}

// Only good commands move a guarded output; its make_safe is called again if it throws.
static void outputs_are_guarded(const char *socket)
{
    const auto type = sinew::protected_type<pair>("test.wrapper_command", 20s);
    sinew::endpoint sender(socket), receiver(socket);
    std::atomic<int> fails = 2;
    auto guard = receiver.guard(sender.address(), type, 7, [&fails](int &output, sinew_output_state why) {
        if (why == SINEW_SAFE_TRIPPED && fails-- > 0)
            throw std::runtime_error("it does not move");
        output = 0;
    });
    EXPECT(guard.state() == SINEW_SAFE_NOT_ARMED && !guard.apply([](int &) {}));
    const auto came = come_alive(sender, receiver, type, guard);
    EXPECT(came && came->a == 1 && guard.tally().good > 8);
    int moved = -1;
    EXPECT(guard.apply([&](int &output) { output = came->a, moved = output; }) && moved == 1);
    try {
        (void)guard.apply([](int &) { throw std::runtime_error("a command fails"); });
        EXPECT(false);
    } catch (const std::runtime_error &error) {
        EXPECT(std::string(error.what()) == "a command fails");
    }
    sinew::guard<int> kept = std::move(guard);
    kept.trip();
    while (!is_tripped(kept))
        std::this_thread::sleep_for(1ms);
    EXPECT(fails < 0 && !kept.apply([](int &) {}));
    guards_are_assigned(receiver, sender.address());
    try {
        sender.send_protected(sinew::group("test.all"), type, pair{1, 2});
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_INVALID_ARGUMENT);
    }
}

// A guard that ends in a function that it calls is released then: another one may have its slot.
static void guards_end_in_their_own_functions(const char *socket)
{
    const auto moved = sinew::protected_type<pair>("test.wrapper_ends_moved", 20s);
    const auto tripped = sinew::protected_type<pair>("test.wrapper_ends_tripped", 20s);
    sinew::endpoint sender(socket), receiver(socket);
    std::atomic<int> safe_count = 0;
    std::optional<sinew::guard<int>> guard;
    guard.emplace(receiver.guard(sender.address(), moved, 7, [&safe_count](int &output, sinew_output_state) {
        output = 0;
        safe_count++;
    }));
    EXPECT(come_alive(sender, receiver, moved, *guard) && safe_count == 1);
    EXPECT(guard->apply([&guard](int &output) { guard.reset(), output = 1; }) && !guard);
    EXPECT(safe_count == 2);
    EXPECT(receiver.guard(sender.address(), moved, 7, [](int &, sinew_output_state) {}).state() == SINEW_SAFE_NOT_ARMED);

    std::atomic<bool> has_ended = false;
    guard.emplace(receiver.guard(sender.address(), tripped, 7, [&](int &output, sinew_output_state why) {
        output = 0;
        if (why != SINEW_SAFE_TRIPPED)
            return;
        guard.reset();
        has_ended = true;
    }));
    EXPECT(come_alive(sender, receiver, tripped, *guard));
    guard->trip();
    while (!has_ended)
        std::this_thread::sleep_for(1ms);
    // It is released when make_safe has returned, which may be on another thread.
    const auto guarded_again = [&]() -> std::optional<sinew_output_state> {
        try {
            return receiver.guard(sender.address(), tripped, 7, [](int &, sinew_output_state) {}).state();
        } catch (const sinew::error &) {
            return std::nullopt;
        }
    };
    const auto deadline = std::chrono::steady_clock::now() + 30s;
    auto state = guarded_again();
    while (!state && std::chrono::steady_clock::now() < deadline) {
        std::this_thread::sleep_for(1ms);
        state = guarded_again();
    }
    EXPECT(state == SINEW_SAFE_NOT_ARMED);
}

// The last one: nothing releases the stop.
static void stop_is_pressed(sinew::endpoint &endpoint)
{
    EXPECT(endpoint.ask_stop(20s).state.presses == 0);
    const sinew::stop_report report = endpoint.press_stop("a test", 20s);
    EXPECT(report.state.is_confirmed && report.nodes.size() == 1 && report.nodes[0].confirmed_ns != SINEW_STOP_NO_TIME);
    try {
        endpoint.acknowledge_stop(20s);
        EXPECT(false);
    } catch (const sinew::error &error) {
        EXPECT(error.status() == SINEW_ERROR_NOT_HANDLED);
    }
}

int main(int argc, char **argv)
{
    const char *socket = argc > 1 ? argv[1] : "";
    sinew::endpoint endpoint(socket);
    errors_are_exceptions(endpoint);
    values_are_typed(endpoint);
    types_without_fields(endpoint);
    old_messages_expire(endpoint);
    undelivered_messages_are_counted(endpoint);
    scopes_settle(endpoint, sinew::endpoint(socket));
    unsent_messages_are_given_back(endpoint);
    sends_may_have_a_time(endpoint);
    groups_and_names(socket);
    outputs_are_guarded(socket);
    guards_end_in_their_own_functions(socket);
    stop_is_pressed(endpoint);
    std::puts("all well");
}
