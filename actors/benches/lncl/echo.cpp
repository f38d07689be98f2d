// The echoing end of `cargo bench -p sinew --bench lncl` in C++: the paper's Table 1 with an application that is not Rust's.
//
//   echo SOCKET
#include <sinew.hpp>

#include <cstdio>

int main(int argc, char **argv) try {
    using namespace std::chrono_literals;
    const auto aged = sinew::kind_named("lncl.aged");
    sinew::options options;
    options.name = "echo";
    sinew::endpoint echo(argc > 1 ? argv[1] : "", options);
    std::puts("there");
    std::fflush(stdout);
    while (auto packet = echo.receive(20s)) {
        const std::int64_t age = packet->age().value_or(0ns).count(); // of this host's own clock: always known
        auto back = echo.create(packet->source(), packet->kind(), packet->size());
        std::memcpy(back.data(), packet->data(), packet->size());
        if (packet->kind() == aged && back.size() >= sizeof age)
            std::memcpy(back.data(), &age, sizeof age);
        packet.reset();
        echo.send(std::move(back));
    }
} catch (const sinew::error &error) {
    std::fprintf(stderr, "echo: %s\n", error.what());
    return 1;
}
