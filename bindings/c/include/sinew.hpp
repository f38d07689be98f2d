// Sinew: NodeAPI for C++17 and later, on top of sinew.h, which has the contract. Header only.
//
// Errors are exceptions of type sinew::error. A program that continues with an endpoint that has ended, or
// with a message that was not sent, may move a limb by accident; a status can be overlooked, an exception
// cannot. The ordinary course of a control loop is no error and throws nothing: no message in time
// (std::optional), no room in time (send_within: false), an unknown name (std::optional), a message that was
// not handled (its outcome). Programs without exceptions use sinew.h.
//
// One thread at a time uses an endpoint and the objects that come from it.
#ifndef SINEW_HPP
#define SINEW_HPP

#include "sinew.h"

#include <array>
#include <chrono>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <exception>
#include <functional>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

#if !defined(__cpp_exceptions)
#error "sinew.hpp reports errors by exceptions; take sinew.h with -fno-exceptions"
#endif

namespace sinew {

using tid = sinew_tid;
using kind = sinew_kind;
using duration = std::chrono::nanoseconds;

/// A call that failed: its status, and the library's sentence about it.
class error : public std::runtime_error {
public:
    explicit error(sinew_status status) : std::runtime_error(sinew_last_error()), status_(status) {}
    sinew_status status() const noexcept { return status_; }

private:
    sinew_status status_;
};

namespace detail {

inline sinew_status check(sinew_status status)
{
    if (status < 0)
        throw error(status);
    return status;
}

inline sinew_text text(std::string_view view) noexcept
{
    sinew_text text;
    text.bytes = view.data();
    text.length = view.size();
    return text;
}

inline std::uint64_t nanoseconds(duration within) noexcept
{
    return within.count() < 0 ? 0 : static_cast<std::uint64_t>(within.count());
}

inline duration time(std::uint64_t nanoseconds) noexcept
{
    constexpr auto most = static_cast<std::uint64_t>(duration::max().count());
    return duration(static_cast<std::int64_t>(nanoseconds < most ? nanoseconds : most));
}

} // namespace detail

/// The kind of the payload type called `name`.
inline kind kind_named(std::string_view name) { return sinew_kind_named(detail::text(name)); }

/// The address of the group called `name`, for its members on every node.
inline tid group(std::string_view name) { return sinew_group(detail::text(name)); }

/// A TID as text, as in `10.0.0.7/1001`.
inline std::string to_string(tid address)
{
    char text[SINEW_TID_TEXT];
    detail::check(sinew_tid_text(address, text, sizeof text));
    return text;
}

/// The table of a struct's fields: written by SINEW_STRUCT and SINEW_PAYLOAD.
template <class T> struct layout_of;
/// A payload type, with its name and class: written by SINEW_PAYLOAD.
template <class T> struct payload_of;

namespace detail {

template <class T, class = void> struct is_described : std::false_type {};
template <class T> struct is_described<T, std::void_t<decltype(payload_of<T>::get())>> : std::true_type {};

template <class M> struct element { using type = M; static constexpr std::uint32_t flags = 0; };
template <class M, std::size_t N> struct element<M[N]> { using type = M; static constexpr std::uint32_t flags = SINEW_FIELD_ARRAY; };
template <class M, std::size_t N> struct element<std::array<M, N>> : element<M[N]> {};
template <std::size_t N> struct element<char[N]> { using type = char[N]; static constexpr std::uint32_t flags = 0; };
template <std::size_t N> struct element<std::array<char, N>> : element<char[N]> {};

template <class E> constexpr std::uint32_t field_type()
{
    if constexpr (std::is_same_v<E, bool>)
        return SINEW_TYPE_BOOL;
    else if constexpr (std::is_same_v<E, float>)
        return SINEW_TYPE_F32;
    else if constexpr (std::is_same_v<E, double>)
        return SINEW_TYPE_F64;
    else if constexpr (std::is_array_v<E>)
        return SINEW_TYPE_TEXT;
    else if constexpr (std::is_integral_v<E> || std::is_enum_v<E>) {
        static_assert(!std::is_same_v<E, char>, "a lone char is no number and no text: take std::uint8_t, or an array of char");
        using number = typename std::conditional_t<std::is_enum_v<E>, std::underlying_type<E>, std::common_type<E>>::type;
        constexpr bool is_signed = std::is_signed_v<number>;
        constexpr std::uint32_t types[] = {is_signed ? SINEW_TYPE_I8 : SINEW_TYPE_U8, is_signed ? SINEW_TYPE_I16 : SINEW_TYPE_U16,
                                           is_signed ? SINEW_TYPE_I32 : SINEW_TYPE_U32, is_signed ? SINEW_TYPE_I64 : SINEW_TYPE_U64};
        return types[sizeof(E) == 1 ? 0 : sizeof(E) == 2 ? 1 : sizeof(E) == 4 ? 2 : 3];
    } else
        return SINEW_TYPE_STRUCT;
}

template <class M> sinew_field field(const char *name, std::size_t offset)
{
    using E = typename element<M>::type;
    sinew_field made{name, offset, sizeof(M), 0, nullptr, field_type<E>(), element<M>::flags};
    if constexpr (field_type<E>() == SINEW_TYPE_STRUCT)
        made.layout = &layout_of<E>::get();
    return made;
}

inline std::array<sinew_field, 0> fields() { return {}; }
template <class... F> std::array<sinew_field, 1 + sizeof...(F)> fields(sinew_field first, F... rest) { return {{first, rest...}}; }

} // namespace detail

/// Options of a registration; unset ones have the default of sinew_options.
struct options {
    std::string name;
    std::vector<std::string> required;
    std::vector<std::string> handled;
    std::uint32_t fixed_address = 0;
    std::uint32_t events = 0;
    duration deadline{};
    duration stall_timeout{};
    std::size_t inbox_capacity = 0;
    duration spin{};
    std::uint32_t links = 0;
    std::size_t direct_ring_bytes = 0;
};

/// A barrier, or with SINEW_PHASE a phase: where several applications wait for each other. Without a time: 60 s.
struct barrier {
    std::string name;
    std::vector<std::string> parties;
    duration within{};
    std::uint32_t flags = 0;
};

/// The state of the stop of the whole system, and its nodes, of which the first 64 are kept.
struct stop_report {
    sinew_stop_report state{};
    std::vector<sinew_stop_node> nodes = std::vector<sinew_stop_node>(64);
};

/// A message under construction: a container of writable bytes. If it is not sent, its destructor discards
/// it.
class message {
public:
    message(message &&other) noexcept
        : endpoint_(other.endpoint_), raw_(std::exchange(other.raw_, sinew_message{})) {}
    message &operator=(message &&other) noexcept
    {
        std::swap(endpoint_, other.endpoint_);
        std::swap(raw_, other.raw_);
        return *this;
    }
    ~message()
    {
        if (raw_.token != 0)
            (void)sinew_discard_message(endpoint_, &raw_);
    }

    std::uint8_t *data() noexcept { return raw_.bytes; }
    std::size_t size() const noexcept { return raw_.length; }
    /// Sets its time to live, in place of its type's: `drive.send(drive.create(to,
    /// value).expires_after(20ms))`.
    message &&expires_after(duration time) &&
    {
        detail::check(sinew_expires_after(endpoint_, &raw_, detail::nanoseconds(time)));
        return std::move(*this);
    }
    /// Sets the longest wait for room when it is sent; zero does not wait. Without room in time
    /// `drive.send(drive.create(to, value).room_within(200us))` throws `SINEW_ERROR_STALLED`, and
    /// `send_within` returns false.
    message &&room_within(duration time) &&
    {
        detail::check(sinew_room_within(endpoint_, &raw_, detail::nanoseconds(time)));
        return std::move(*this);
    }
    std::uint8_t *begin() noexcept { return data(); }
    std::uint8_t *end() noexcept { return data() + size(); }

private:
    friend class endpoint;
    explicit message(sinew_endpoint *endpoint) noexcept : endpoint_(endpoint), raw_{} {}

    sinew_endpoint *endpoint_;
    sinew_message raw_;
};

/// A received message: a container of readable bytes. Its destructor settles it as handled, or as failed
/// during an exception; settle reports another outcome, or reports it sooner.
class received {
public:
    received(received &&other) noexcept
        : endpoint_(other.endpoint_), raw_(std::exchange(other.raw_, sinew_received{})), exceptions_(other.exceptions_) {}
    received &operator=(received &&other) noexcept
    {
        std::swap(endpoint_, other.endpoint_);
        std::swap(raw_, other.raw_);
        std::swap(exceptions_, other.exceptions_);
        return *this;
    }
    ~received()
    {
        if (raw_.token == 0)
            return;
        const bool failed = std::uncaught_exceptions() > exceptions_;
        (void)sinew_settle_message(endpoint_, &raw_, failed ? SINEW_FAILED : SINEW_DELIVERED);
    }

    const std::uint8_t *data() const noexcept { return raw_.bytes; }
    std::size_t size() const noexcept { return raw_.length; }
    const std::uint8_t *begin() const noexcept { return data(); }
    const std::uint8_t *end() const noexcept { return data() + size(); }

    tid source() const noexcept { return raw_.source; }
    tid destination() const noexcept { return raw_.destination; }
    sinew::kind kind() const noexcept { return raw_.kind; }
    std::uint64_t sequence() const noexcept { return raw_.sequence; }
    bool wants_reply() const noexcept { return raw_.wants_reply; }
    /// Time since it was sent, with an error of up to age_error(); nothing while the clock of the sender's
    /// host is not measured, or not precisely enough.
    std::optional<duration> age() const noexcept { return age_of(sinew_age); }
    /// The maximum error of the age: none for a message of this host, nothing if the age is not known.
    std::optional<duration> age_error() const noexcept
    {
        return raw_.is_sent_known ? std::optional(detail::time(raw_.sent_error_ns)) : std::nullopt;
    }
    /// The maximum age; nothing if that is not known.
    std::optional<duration> age_at_most() const noexcept { return age_of(sinew_age_at_most); }
    /// Whether it may be older than this: for a loop that may use fresh values only. An unknown age counts as
    /// too old.
    bool is_older_than(duration limit) const noexcept { return sinew_is_older_than(&raw_, detail::nanoseconds(limit)); }

    /// The payload as a value of a type that SINEW_PAYLOAD describes; nothing if the message is of another
    /// kind. A payload that cannot be read throws SINEW_ERROR_MALFORMED with the field's name. Of any other
    /// struct: its bytes; nothing if it has another size.
    template <class T> std::optional<T> as() const
    {
        if constexpr (detail::is_described<T>::value) {
            T value{};
            if (detail::check(sinew_read_value(&raw_, &payload_of<T>::get(), &value)) == SINEW_NOTHING)
                return std::nullopt;
            return value;
        }
        static_assert(std::is_trivially_copyable_v<T>, "only a plain struct can be copied out of bytes");
        if (size() != sizeof(T))
            return std::nullopt;
        T value;
        std::memcpy(&value, data(), sizeof(T));
        return value;
    }

    /// Settles it with this outcome, and frees its bytes.
    void settle(sinew_outcome outcome) { detail::check(sinew_settle_message(endpoint_, &raw_, outcome)); }

private:
    friend class endpoint;
    std::optional<duration> age_of(bool (*how)(const sinew_received *, std::uint64_t *)) const noexcept
    {
        std::uint64_t age_ns = 0;
        return how(&raw_, &age_ns) ? std::optional(detail::time(age_ns)) : std::nullopt;
    }
    explicit received(sinew_endpoint *endpoint) noexcept : endpoint_(endpoint), raw_{} {}

    sinew_endpoint *endpoint_;
    sinew_received raw_;
    int exceptions_ = std::uncaught_exceptions();
};

/// A type of protected payloads: a `T`, one each `period`; its fields may be changed. `name` must stay, as a
/// literal does.
template <class T> sinew_protected_type protected_type(std::string_view name, duration period)
{
    static_assert(std::is_trivially_copyable_v<T>, "only a plain struct can be sent as its bytes");
    return sinew_protected_type_of(detail::text(name), sizeof(T), detail::nanoseconds(period));
}

/// The only access to an output: see sinew_guard_output. Its destructor makes the output safe. If that fails,
/// it is retried, and the guard's slot is free as soon as the output is safe. The output's memory is not
/// freed then, and all that it refers to must stay. The same holds if a guard ends in a function that a guard
/// calls, even its own: it is released as soon as no thread uses its output. While making safe fails, state
/// and apply throw SINEW_ERROR_SAFE_FAILS. Any thread may use it.
template <class Output> class guard {
public:
    /// Makes the output safe, on any thread; one that throws is called again each millisecond. An empty one
    /// is rejected.
    using make_safe = std::function<void(Output &, sinew_output_state)>;

    guard(guard &&other) noexcept : held_(std::move(other.held_)), raw_(std::exchange(other.raw_, nullptr)) {}
    /// Makes the output safe that it had before, as the destructor of a guard does.
    guard &operator=(guard &&other) noexcept
    {
        if (this != &other) {
            release();
            held_ = std::move(other.held_);
            raw_ = std::exchange(other.raw_, nullptr);
        }
        return *this;
    }
    ~guard() { release(); }

    /// Makes the output live if enough good messages have arrived; returns whether it did.
    [[nodiscard]] bool arm()
    {
        const sinew_status status = sinew_arm(raw_);
        return status != SINEW_ERROR_NOT_GOOD && detail::check(status) == SINEW_OK;
    }
    /// Calls `command(output)` if the output is live; returns whether it was. Rethrows exceptions of the
    /// command.
    template <class Command> [[nodiscard]] bool apply(Command &&command)
    {
        struct call { Command &command; std::exception_ptr thrown; } argument{command, nullptr};
        const auto run = [](void *held, void *data) {
            call &called = *static_cast<call *>(data);
            try {
                called.command(static_cast<state_of *>(held)->output);
            } catch (...) { called.thrown = std::current_exception(); }
        };
        const bool is_live = detail::check(sinew_apply(raw_, run, &argument, nullptr)) == SINEW_OK;
        if (argument.thrown)
            std::rethrow_exception(argument.thrown);
        return is_live;
    }
    /// Makes the output safe, at once or as soon as no thread uses it.
    void trip() { detail::check(sinew_trip(raw_)); }
    sinew_output_state state() const
    {
        sinew_output_state state = SINEW_SAFE_NOT_ARMED;
        return detail::check(sinew_guard_state(raw_, &state)), state;
    }
    sinew_tally tally() const
    {
        sinew_tally tally{};
        return detail::check(sinew_guard_tally(raw_, &tally)), tally;
    }

private:
    friend class endpoint;
    struct state_of { Output output; make_safe safe; };
    guard(Output output, make_safe safe) : held_(new state_of{std::move(output), std::move(safe)}) {}
    void release() noexcept
    {
        if (raw_ == nullptr || sinew_release(&raw_) == SINEW_OK)
            return;
        // In a function that a guard calls, maybe this one, or if the output is not safe: the library
        // completes the release, and the functions that it calls must be valid for that.
        (void)sinew_release_later(&raw_);
        (void)held_.release();
        raw_ = nullptr;
    }
    static std::int32_t run_safe(void *held, sinew_output_state why)
    try {
        static_cast<state_of *>(held)->safe(static_cast<state_of *>(held)->output, why);
        return 0;
    } catch (...) {
        return 1;
    }

    std::unique_ptr<state_of> held_;
    sinew_guard *raw_ = nullptr;
};

/// A transport address of this process. Its destructor unregisters it.
class endpoint {
public:
    /// Registers at the node with the socket `socket`, and waits until all requirements are ready.
    explicit endpoint(std::string_view socket, const options &wanted = {})
    {
        const auto required = texts(wanted.required), handled = texts(wanted.handled);
        sinew_options raw{};
        raw.size = sizeof raw;
        raw.name = detail::text(wanted.name);
        raw.required = required.data();
        raw.required_count = required.size();
        raw.handled = handled.data();
        raw.handled_count = handled.size();
        raw.fixed_address = wanted.fixed_address;
        raw.events = wanted.events;
        raw.deadline_ns = detail::nanoseconds(wanted.deadline);
        raw.stall_timeout_ns = detail::nanoseconds(wanted.stall_timeout);
        raw.inbox_capacity = wanted.inbox_capacity;
        raw.spin_ns = detail::nanoseconds(wanted.spin);
        raw.links = wanted.links;
        raw.direct_ring_bytes = wanted.direct_ring_bytes;
        detail::check(sinew_register_transport_address(detail::text(socket), &raw, &raw_));
    }
    endpoint(endpoint &&other) noexcept : raw_(std::exchange(other.raw_, nullptr)) {}
    endpoint &operator=(endpoint &&other) noexcept
    {
        std::swap(raw_, other.raw_);
        return *this;
    }
    /// Unregisters, and blocks until the node has released the address: 2 s at most, if the node hangs.
    /// Received messages that were not settled end as failed. To learn whether the node released it call
    /// `unregister` first.
    ~endpoint()
    {
        if (raw_ != nullptr)
            (void)sinew_unregister(&raw_);
    }

    tid address() const noexcept { return sinew_endpoint_tid(raw_); }
    std::size_t payload_max() const noexcept { return sinew_payload_max(raw_); }
    std::string node_name() const
    {
        const char *name = sinew_node_name(raw_);
        return name != nullptr ? name : "";
    }

    /// Loans writable bytes, all zeros, for a message. One at a time: the endpoint sends nothing else until
    /// it is sent or destroyed.
    message create(tid destination, kind what, std::size_t length, sinew_message_class how = SINEW_CONTROL)
    {
        message created(raw_);
        detail::check(sinew_create_message(raw_, destination, what, how, length, &created.raw_));
        return created;
    }

    /// Creates a message with a value of a type that SINEW_PAYLOAD describes, in its class, for any function
    /// that sends.
    template <class T> message create(tid destination, const T &value)
    {
        static_assert(detail::is_described<T>::value, "describe the type by SINEW_PAYLOAD(type, \"name\", class, fields...)");
        message created(raw_);
        detail::check(sinew_create_value(raw_, destination, &payload_of<T>::get(), &value, &created.raw_));
        return created;
    }
    /// Sends a value of a type that SINEW_PAYLOAD describes, in the class of that type.
    template <class T> void send(tid destination, const T &value) { send(create(destination, value)); }

    /// Sends a message, without reporting its outcome.
    void send(message &&made) { detail::check(sinew_send_message(raw_, &made.raw_)); }
    /// Sends a plain struct.
    template <class T> void send(tid destination, kind what, const T &value, sinew_message_class how = SINEW_CONTROL)
    {
        send(filled(destination, what, value, how));
    }

    /// Sends a message if there is room in time, zero: now; returns whether there was. A message that is not
    /// sent is gone.
    [[nodiscard]] bool send_within(message &&made, duration within)
    {
        auto timed = std::move(made).room_within(within);
        return is_sent(sinew_send_message(raw_, &timed.raw_));
    }
    /// Sends a plain struct if there is room in time.
    template <class T>
    [[nodiscard]] bool send_within(tid destination, kind what, const T &value, duration within,
                                   sinew_message_class how = SINEW_CONTROL)
    {
        return send_within(filled(destination, what, value, how), within);
    }

    /// Sends a message and waits for its outcome; SINEW_UNKNOWN if none arrived in time.
    [[nodiscard]] sinew_outcome confirm(message &&made, duration within)
    {
        sinew_outcome outcome = SINEW_UNKNOWN;
        detail::check(sinew_send_message_confirmed(raw_, &made.raw_, detail::nanoseconds(within), &outcome));
        return outcome;
    }
    /// Sends a plain struct and waits for its outcome.
    template <class T> [[nodiscard]] sinew_outcome confirm(tid destination, kind what, const T &value, duration within)
    {
        return confirm(filled(destination, what, value, SINEW_CONTROL), within);
    }

    /// Sends a message to a group, to every application or to an address on all nodes, and waits for its
    /// outcome at each member; SINEW_UNKNOWN for those without an outcome in time. Empty for a group without
    /// members.
    [[nodiscard]] std::vector<sinew_member_outcome> confirm_by_each(message &&made, duration within)
    {
        std::vector<sinew_member_outcome> members(SINEW_MEMBERS_MAX);
        std::size_t count = 0;
        detail::check(sinew_send_message_confirmed_by_each(raw_, &made.raw_, detail::nanoseconds(within), members.data(),
                                                           members.size(), &count));
        members.resize(count);
        return members;
    }
    /// Sends a plain struct to many and waits for its outcome at each member.
    template <class T>
    [[nodiscard]] std::vector<sinew_member_outcome> confirm_by_each(tid destination, kind what, const T &value,
                                                                    duration within)
    {
        return confirm_by_each(filled(destination, what, value, SINEW_CONTROL), within);
    }

    /// Sends a request and waits for the reply.
    received ask(message &&made, duration within)
    {
        received reply(raw_);
        detail::check(sinew_ask(raw_, &made.raw_, detail::nanoseconds(within), &reply.raw_, nullptr));
        return reply;
    }
    /// Sends a plain struct as a request and waits for the reply.
    template <class T> received ask(tid destination, kind what, const T &value, duration within)
    {
        return ask(filled(destination, what, value, SINEW_CONTROL), within);
    }

    /// Replies to a request.
    void reply(const received &request, message &&made) { detail::check(sinew_reply(raw_, &request.raw_, &made.raw_)); }
    /// Replies with a plain struct.
    template <class T> void reply(const received &request, kind what, const T &value)
    {
        reply(request, filled(request.source(), what, value, SINEW_CONTROL));
    }

    /// Replies to a request if there is room in time; returns whether there was.
    [[nodiscard]] bool reply_within(const received &request, message &&made, duration within)
    {
        auto timed = std::move(made).room_within(within);
        return is_sent(sinew_reply(raw_, &request.raw_, &timed.raw_));
    }

    /// Seals a plain struct and sends it to one application; see sinew_send_protected.
    template <class T> void send_protected(tid destination, const sinew_protected_type &what, const T &value)
    {
        static_assert(std::is_trivially_copyable_v<T>, "only a plain struct can be sent as its bytes");
        detail::check(sinew_send_protected(raw_, destination, &what, &value, sizeof value));
    }
    /// Guards an output: only good messages of a protected type from `source` move it; `make_safe` is called
    /// otherwise.
    template <class Output>
    [[nodiscard]] sinew::guard<Output> guard(tid source, const sinew_protected_type &what, Output output,
                                             typename sinew::guard<Output>::make_safe safe)
    {
        const sinew_make_safe run = safe ? &sinew::guard<Output>::run_safe : nullptr;
        sinew::guard<Output> made(std::move(output), std::move(safe));
        detail::check(sinew_guard_output(raw_, source, &what, made.held_.get(), run, &made.raw_));
        return made;
    }

    /// Waits for a message; nothing if none arrived in time.
    [[nodiscard]] std::optional<received> receive(duration within)
    {
        received came(raw_);
        const sinew_status status = sinew_receive_message(raw_, detail::nanoseconds(within), &came.raw_);
        if (detail::check(status) == SINEW_NOTHING)
            return std::nullopt;
        return came;
    }

    /// Returns the next report of unconfirmed messages that were not delivered; nothing if there is nothing new.
    [[nodiscard]] std::optional<sinew_undelivered> take_undelivered()
    {
        sinew_undelivered next;
        if (detail::check(sinew_next_undelivered(raw_, &next)) == SINEW_NOTHING)
            return std::nullopt;
        return next;
    }

    /// Resolves a name to the application that has it now, on any node; nothing if none has.
    [[nodiscard]] std::optional<tid> resolve(std::string_view name, duration within)
    {
        tid found = 0;
        const sinew_status status = sinew_resolve(raw_, detail::text(name), detail::nanoseconds(within), &found);
        if (detail::check(status) == SINEW_NOTHING)
            return std::nullopt;
        return found;
    }

    /// Arrives at a barrier and waits until all parties have; returns the number of its openings. An error
    /// names the missing parties.
    std::uint64_t meet(const barrier &where)
    {
        const std::vector<sinew_text> parties = texts(where.parties);
        sinew_barrier raw{};
        raw.name = detail::text(where.name);
        raw.parties = parties.data();
        raw.parties_count = parties.size();
        raw.within_ns = detail::nanoseconds(where.within);
        raw.flags = where.flags;
        std::uint64_t generation = 0;
        detail::check(sinew_meet(raw_, &raw, &generation));
        return generation;
    }

    /// Presses the stop of the whole system. Returns when all nodes have confirmed, and after this time at the latest:
    /// look at `state.is_confirmed`. It is no safety function. After an error the stop may be pressed.
    stop_report press_stop(std::string_view reason, duration within)
    {
        stop_report found;
        const auto count = found.nodes.size();
        detail::check(sinew_press_stop(raw_, detail::text(reason), detail::nanoseconds(within), found.nodes.data(), count, &found.state));
        found.nodes.resize(found.state.nodes < count ? found.state.nodes : count);
        return found;
    }

    /// Asks for the state of the stop.
    [[nodiscard]] stop_report ask_stop(duration within)
    {
        stop_report found;
        const auto count = found.nodes.size();
        detail::check(sinew_ask_stop(raw_, detail::nanoseconds(within), found.nodes.data(), count, &found.state));
        found.nodes.resize(found.state.nodes < count ? found.state.nodes : count);
        return found;
    }

    /// Acknowledges a stop that is released, on the order of a person. While one is in force this is an error with the
    /// status `SINEW_ERROR_NOT_HANDLED`.
    void acknowledge_stop(duration within) { detail::check(sinew_acknowledge_stop(raw_, detail::nanoseconds(within))); }

    void join(std::string_view name) { detail::check(sinew_join_group(raw_, detail::text(name))); }
    void leave(std::string_view name) { detail::check(sinew_leave_group(raw_, detail::text(name))); }

    /// Unregisters and waits until the node has released the address: then the name is free.
    void unregister() { detail::check(sinew_unregister(&raw_)); }

private:
    static bool is_sent(sinew_status status)
    {
        return status != SINEW_ERROR_STALLED && detail::check(status) == SINEW_OK;
    }

    static std::vector<sinew_text> texts(const std::vector<std::string> &strings)
    {
        std::vector<sinew_text> texts;
        for (const std::string &string : strings)
            texts.push_back(detail::text(string));
        return texts;
    }

    template <class T> message filled(tid destination, kind what, const T &value, sinew_message_class how)
    {
        static_assert(std::is_trivially_copyable_v<T>, "only a plain struct can be sent as its bytes");
        message made = create(destination, what, sizeof value, how);
        std::memcpy(made.data(), &value, sizeof value);
        return made;
    }

    sinew_endpoint *raw_ = nullptr;
};

} // namespace sinew

/// Describes a struct as a payload type: SINEW_PAYLOAD(torque, "knee.torque", SINEW_STREAM, newton_metres,
/// number). At file scope, outside of all namespaces. It is sent as MessagePack with the names of its fields,
/// which Rust reads as the `payload!` of the same name. Fields, at most 32: bool, numbers, enums, text (an
/// array of char that ends with a zero), structs with SINEW_STRUCT, and arrays of these but text. A struct
/// without fields, such as a command `struct stop {};`, is described without them: SINEW_PAYLOAD(stop,
/// "knee.stop", SINEW_CONTROL).
#define SINEW_PAYLOAD(T, NAME, ...) \
    SINEW_STRUCT_OF(T, SINEW_EACH(T, __VA_ARGS__)) \
    SINEW_PAYLOAD_OF(T, NAME, SINEW_FIRST(__VA_ARGS__, ), 0)
/// The same with a time to live, a constant above zero: SINEW_PAYLOAD_EXPIRING(torque, "knee.torque",
/// SINEW_STREAM, std::chrono::milliseconds(20), newton_metres). An older message expires in its queue.
#define SINEW_PAYLOAD_EXPIRING(T, NAME, CLASS, ...) \
    static_assert(sinew::duration(SINEW_FIRST(__VA_ARGS__, )) > sinew::duration::zero(), "a time to live is above zero"); \
    SINEW_STRUCT_OF(T, SINEW_EACH(T, __VA_ARGS__)) \
    SINEW_PAYLOAD_OF(T, NAME, CLASS, sinew::detail::nanoseconds(SINEW_FIRST(__VA_ARGS__, )))
/// Describes a struct that is a field of another: SINEW_STRUCT(gain, p, d).
#define SINEW_STRUCT(...) SINEW_STRUCT_OF(SINEW_FIRST(__VA_ARGS__, ), SINEW_EACH(SINEW_FIRST(__VA_ARGS__, ), __VA_ARGS__))

#define SINEW_PAYLOAD_OF(T, NAME, CLASS, EXPIRES_AFTER_NS) \
    template <> struct sinew::payload_of<T> { \
        static const sinew_payload_type &get() \
        { \
            static const sinew_payload_type type = {sinew::detail::text(NAME), CLASS, sinew::layout_of<T>::get(), EXPIRES_AFTER_NS}; \
            return type; \
        } \
    };
#define SINEW_STRUCT_OF(T, ...) \
    template <> struct sinew::layout_of<T> { \
        static_assert(std::is_standard_layout_v<T> && std::is_trivially_copyable_v<T>, "only a plain struct has fields at fixed places"); \
        static const sinew_layout &get() \
        { \
            static const auto fields = sinew::detail::fields(__VA_ARGS__); \
            static_assert(std::is_empty_v<T> || std::tuple_size_v<decltype(fields)> != 0, "name the fields: only a struct without fields is described without them"); \
            static const sinew_layout layout = {fields.data(), fields.size(), sizeof(T)}; \
            return layout; \
        } \
    };

#define SINEW_FIRST(FIRST, ...) FIRST
#define SINEW_FIELD_OF(T, M) sinew::detail::field<decltype(T::M)>(#M, offsetof(T, M))
// The fields after the first argument, T.
#define SINEW_EACH_0(T, FIRST)
#define SINEW_EACH_1(T, FIRST, M) SINEW_FIELD_OF(T, M)
#define SINEW_EACH_2(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_1(T, M, __VA_ARGS__)
#define SINEW_EACH_3(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_2(T, M, __VA_ARGS__)
#define SINEW_EACH_4(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_3(T, M, __VA_ARGS__)
#define SINEW_EACH_5(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_4(T, M, __VA_ARGS__)
#define SINEW_EACH_6(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_5(T, M, __VA_ARGS__)
#define SINEW_EACH_7(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_6(T, M, __VA_ARGS__)
#define SINEW_EACH_8(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_7(T, M, __VA_ARGS__)
#define SINEW_EACH_9(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_8(T, M, __VA_ARGS__)
#define SINEW_EACH_10(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_9(T, M, __VA_ARGS__)
#define SINEW_EACH_11(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_10(T, M, __VA_ARGS__)
#define SINEW_EACH_12(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_11(T, M, __VA_ARGS__)
#define SINEW_EACH_13(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_12(T, M, __VA_ARGS__)
#define SINEW_EACH_14(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_13(T, M, __VA_ARGS__)
#define SINEW_EACH_15(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_14(T, M, __VA_ARGS__)
#define SINEW_EACH_16(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_15(T, M, __VA_ARGS__)
#define SINEW_EACH_17(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_16(T, M, __VA_ARGS__)
#define SINEW_EACH_18(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_17(T, M, __VA_ARGS__)
#define SINEW_EACH_19(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_18(T, M, __VA_ARGS__)
#define SINEW_EACH_20(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_19(T, M, __VA_ARGS__)
#define SINEW_EACH_21(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_20(T, M, __VA_ARGS__)
#define SINEW_EACH_22(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_21(T, M, __VA_ARGS__)
#define SINEW_EACH_23(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_22(T, M, __VA_ARGS__)
#define SINEW_EACH_24(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_23(T, M, __VA_ARGS__)
#define SINEW_EACH_25(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_24(T, M, __VA_ARGS__)
#define SINEW_EACH_26(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_25(T, M, __VA_ARGS__)
#define SINEW_EACH_27(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_26(T, M, __VA_ARGS__)
#define SINEW_EACH_28(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_27(T, M, __VA_ARGS__)
#define SINEW_EACH_29(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_28(T, M, __VA_ARGS__)
#define SINEW_EACH_30(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_29(T, M, __VA_ARGS__)
#define SINEW_EACH_31(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_30(T, M, __VA_ARGS__)
#define SINEW_EACH_32(T, FIRST, M, ...) SINEW_FIELD_OF(T, M), SINEW_EACH_31(T, M, __VA_ARGS__)
#define SINEW_PICK(_0, _1, _2, _3, _4, _5, _6, _7, _8, _9, _10, _11, _12, _13, _14, _15, _16, _17, _18, _19, _20, _21, _22, _23, _24, _25, _26, _27, _28, _29, _30, _31, _32, NAME, ...) NAME
#define SINEW_EACH(T, ...) SINEW_PICK(__VA_ARGS__, SINEW_EACH_32, SINEW_EACH_31, SINEW_EACH_30, SINEW_EACH_29, SINEW_EACH_28, SINEW_EACH_27, SINEW_EACH_26, SINEW_EACH_25, SINEW_EACH_24, SINEW_EACH_23, SINEW_EACH_22, SINEW_EACH_21, SINEW_EACH_20, SINEW_EACH_19, SINEW_EACH_18, SINEW_EACH_17, SINEW_EACH_16, SINEW_EACH_15, SINEW_EACH_14, SINEW_EACH_13, SINEW_EACH_12, SINEW_EACH_11, SINEW_EACH_10, SINEW_EACH_9, SINEW_EACH_8, SINEW_EACH_7, SINEW_EACH_6, SINEW_EACH_5, SINEW_EACH_4, SINEW_EACH_3, SINEW_EACH_2, SINEW_EACH_1, SINEW_EACH_0, )(T, __VA_ARGS__)

#endif // SINEW_HPP
