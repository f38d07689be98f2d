// The knee's drive: takes angles as they come, answers who asks for a report, ends when nothing comes for 2 s.
#include <sinew.hpp>

#include <cstdio>

struct joint_angle { float degrees; std::uint32_t number; };
struct drive_report { float degrees; std::uint32_t number; };

int main(int argc, char **argv) try {
    using namespace std::chrono_literals;
    const auto angle_kind = sinew::kind_named("demo.joint_angle"), report_kind = sinew::kind_named("demo.drive_report");
    sinew::options options;
    options.name = "knee.drive";
    sinew::endpoint drive(argc > 1 ? argv[1] : "", options);
    std::printf("drive is %s\n", sinew::to_string(drive.address()).c_str());
    std::fflush(stdout);
    drive_report report{};
    for (auto patience = 30s; auto message = drive.receive(patience); patience = 2s) {
        auto angle = message->as<joint_angle>();
        if (message->kind() == angle_kind && angle && angle->number > report.number) // Control overtakes Stream
            report = {angle->degrees, angle->number};
        if (message->kind() == report_kind && message->wants_reply())
            drive.reply(*message, report_kind, report);
    }
    std::printf("last angle was number %u\n", static_cast<unsigned>(report.number));
} catch (const sinew::error &error) {
    std::fprintf(stderr, "drive: %s\n", error.what());
    return 1;
}
