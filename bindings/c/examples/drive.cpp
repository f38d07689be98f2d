// The knee's drive: receives angles, answers requests for a report, ends when nothing arrives for 2 s.
#include <sinew.hpp>

#include <cstdio>

struct joint_angle { float degrees; std::uint32_t number; };
SINEW_PAYLOAD(joint_angle, "demo.joint_angle", SINEW_STREAM, degrees, number)
struct drive_report { float degrees; std::uint32_t number; };
SINEW_PAYLOAD(drive_report, "demo.drive_report", SINEW_CONTROL, degrees, number)

int main(int argc, char **argv) try {
    using namespace std::chrono_literals;
    sinew::options options;
    options.name = "knee.drive";
    sinew::endpoint drive(argc > 1 ? argv[1] : "", options);
    std::printf("drive is %s\n", sinew::to_string(drive.address()).c_str());
    std::fflush(stdout);
    drive_report report{};
    for (auto patience = 30s; auto message = drive.receive(patience); patience = 2s) {
        if (auto angle = message->as<joint_angle>(); angle && angle->number > report.number) // Control overtakes Stream
            report = {angle->degrees, angle->number};
        if (message->wants_reply())
            drive.reply(*message, drive.create(message->source(), report));
    }
    std::printf("last angle was number %u\n", static_cast<unsigned>(report.number));
} catch (const sinew::error &error) {
    std::fprintf(stderr, "drive: %s\n", error.what());
    return 1;
}
