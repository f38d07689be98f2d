//! Units of systemd for the nodes of a robot. Pure.

use std::{fmt::Write as _, path::Path, time::Duration};

use super::order::{NodeOrder, ProgramOrder};

/// Interval within which a node has to report its progress to systemd.
const WATCHDOG_S: u64 = 5;
/// Bytes of a unit's name that need no escape, beside letters and digits (systemd.unit(5)).
const PLAIN: &[u8] = b":_.";

/// A node of one host, for its unit.
#[derive(Debug)]
pub(super) struct UnitOrder<'o> {
    pub(super) robot: &'o str,
    pub(super) order: &'o NodeOrder,
    /// The nodes of the same host that are started before.
    pub(super) after: &'o [String],
    pub(super) user: Option<&'o str>,
    /// The folder of the robot on the host.
    pub(super) folder: &'o Path,
    pub(super) stop_within: Duration,
}

/// Returns the name of a unit: `sinew-ROBOT-NODE.service`, or that of the robot as a whole without a node.
pub(super) fn unit_name(robot: &str, node: &str, kind: &str) -> String {
    let node = if node.is_empty() { String::new() } else { format!("-{}", escaped(node)) };
    format!("sinew-{}{node}.{kind}", escaped(robot))
}

/// Returns a part of a unit's name. Each byte that is not plain is written as `\xNN`, so that names stay different.
fn escaped(name: &str) -> String {
    let mut escaped = String::new();
    for byte in name.bytes() {
        if byte.is_ascii_alphanumeric() || PLAIN.contains(&byte) {
            escaped.push(byte.into());
        } else {
            let _ = write!(escaped, "\\x{byte:02x}");
        }
    }
    escaped
}

/// Returns the target that starts and stops all nodes of one host.
pub(super) fn target(robot: &str, nodes: &[&str]) -> String {
    let wants: Vec<_> = nodes.iter().map(|node| unit_name(robot, node, "service")).collect();
    format!(
        "[Unit]\nDescription=Robot {}\nWants={}\n\n[Install]\nWantedBy=multi-user.target\n",
        plain(robot),
        wants.join(" ")
    )
}

/// Returns the unit of a node.
pub(super) fn service(unit: &UnitOrder<'_>) -> String {
    let UnitOrder { robot, order, after, user, folder, stop_within } = unit;
    let node = folder.join("nodes").join(&order.name);
    let program = match &order.program {
        ProgramOrder::Installed(path) => path.clone(),
        ProgramOrder::Copied { name, .. } => node.join("bin").join(name).display().to_string(),
    };
    let before: String =
        after.iter().map(|other| format!(" {}", unit_name(robot, other, "service"))).collect();
    let mut text = format!(
        "[Unit]\nDescription=Node {} of robot {}\nPartOf={}\nAfter=network.target{before}\nStartLimitIntervalSec=0\n\n[Service]\n",
        plain(&order.name),
        plain(robot),
        unit_name(robot, "", "target"),
    );
    if order.socket.is_some() {
        // A node reports itself when its layers are ready, and while it makes progress.
        let _ = write!(text, "Type=notify\nNotifyAccess=main\nWatchdogSec={WATCHDOG_S}\n");
    } else {
        text += "Type=exec\n";
    }
    let words = std::iter::once(&program).chain(&order.arguments).map(|word| quoted(word, true));
    let _ = writeln!(text, "ExecStart={}", words.collect::<Vec<_>>().join(" "));
    // Of a path, only `%` has a meaning here.
    let _ = writeln!(text, "WorkingDirectory={}", node.display().to_string().replace('%', "%%"));
    if let Some(user) = user {
        let _ = writeln!(text, "User={user}");
    }
    for (name, value) in &order.environment {
        let _ = writeln!(text, "Environment={}", quoted(&format!("{name}={value}"), false));
    }
    let stop_s = stop_within.as_secs().max(1);
    let _ = write!(text, "KillMode=mixed\nTimeoutStopSec={stop_s}\nRestart=on-failure\nRestartSec=1\n");
    text += &limits(order);
    text += "NoNewPrivileges=yes\n\n[Install]\nWantedBy=";
    text += &unit_name(robot, "", "target");
    text.push('\n');
    text
}

fn limits(order: &NodeOrder) -> String {
    let limits = &order.limits;
    let mut text = String::new();
    if limits.realtime_priority_max > 0 {
        let _ = writeln!(text, "LimitRTPRIO={}", limits.realtime_priority_max);
    }
    if limits.lock_memory {
        text += "LimitMEMLOCK=infinity\n";
    }
    if limits.nice != 0 {
        let _ = writeln!(text, "Nice={}", limits.nice);
    }
    if !limits.cpus.is_empty() {
        let cpus: Vec<_> = limits.cpus.iter().map(ToString::to_string).collect();
        let _ = writeln!(text, "CPUAffinity={}", cpus.join(" "));
    }
    text
}

/// Returns one word of a command line or of an assignment in quotes. In a command line `$` has a meaning, too.
fn quoted(word: &str, is_command: bool) -> String {
    let mut quoted = String::from("\"");
    for character in word.chars() {
        match character {
            '"' | '\\' => quoted.extend(['\\', character]),
            '%' => quoted += "%%",
            '$' if is_command => quoted += "$$",
            '\n' => quoted += "\\n",
            other => quoted.push(other),
        }
    }
    quoted.push('"');
    quoted
}

/// Returns a description, in which `%` has no meaning.
fn plain(text: &str) -> String {
    text.replace('%', "%%")
}

#[cfg(test)]
mod tests {
    use std::process::Command;

    use sinew_testkit::TestDirectory;

    use super::*;
    use crate::up::{order::tests::order, robot::Limits};

    const WORDS: [&str; 5] = ["plain", "with space", "100 %", "a \"quoted\" \\ one", "$HOME"];

    /// A node with every limit, and with words that systemd would read in another way.
    fn eager(socket: Option<&str>) -> NodeOrder {
        NodeOrder {
            program: ProgramOrder::Installed("/bin/true".to_owned()),
            arguments: WORDS.map(str::to_owned).to_vec(),
            environment: WORDS.iter().map(|word| ("WORD".to_owned(), (*word).to_owned())).collect(),
            socket: socket.map(str::to_owned),
            limits: Limits { realtime_priority_max: 95, lock_memory: true, nice: -5, cpus: vec![0, 2] },
            ..order("left knee", 1)
        }
    }

    fn unit(order: &NodeOrder, folder: &Path) -> String {
        let after: &[String] = if order.name == "hip" { &[] } else { &["hip".to_owned()] };
        let stop_within = Duration::from_secs(15);
        service(&UnitOrder { robot: "my-leg", order, after, user: Some("root"), folder, stop_within })
    }

    #[test]
    fn unit_has_notification_watchdog_and_limits() {
        let text = unit(&eager(Some("knee.sock")), Path::new("/var/lib/sinew/robots/my-leg"));
        for line in [
            "PartOf=sinew-my\\x2dleg.target",
            "After=network.target sinew-my\\x2dleg-hip.service",
            "Type=notify",
            "WatchdogSec=5",
            "LimitRTPRIO=95",
            "LimitMEMLOCK=infinity",
            "Nice=-5",
            "CPUAffinity=0 2",
            "WorkingDirectory=/var/lib/sinew/robots/my-leg/nodes/left knee",
            r#"ExecStart="/bin/true" "plain" "with space" "100 %%" "a \"quoted\" \\ one" "$$HOME""#,
        ] {
            assert!(text.lines().any(|is| is == line), "{line} is not in:\n{text}");
        }
        let text = unit(&eager(None), Path::new("/"));
        assert!(text.contains("Type=exec\n") && !text.contains("WatchdogSec"), "{text}");
    }

    #[test]
    fn names_of_units_stay_different() {
        assert_eq!(unit_name("leg", "knee", "service"), "sinew-leg-knee.service");
        assert_ne!(unit_name("a-b", "c", "service"), unit_name("a", "b-c", "service"));
        assert_eq!(unit_name("leg", "", "target"), "sinew-leg.target");
    }

    #[test]
    fn systemd_accepts_each_unit() {
        if Command::new("systemd-analyze").arg("--version").output().is_err() {
            println!("skipped: there is no systemd-analyze");
            return;
        }
        let directory = TestDirectory::new();
        std::fs::create_dir_all(directory.join("nodes/left knee")).expect("the test's own directory");
        for socket in [None, Some("knee.sock")] {
            let text = unit(&eager(socket), &directory.join(""));
            let service = directory.write(&unit_name("my-leg", "left knee", "service"), &text);
            let hip = unit(&NodeOrder { name: "hip".to_owned(), ..eager(socket) }, &directory.join(""));
            let hip = directory.write(&unit_name("my-leg", "hip", "service"), &hip);
            let target = target("my-leg", &["hip", "left knee"]);
            let target = directory.write(&unit_name("my-leg", "", "target"), &target);
            let mut command = Command::new("systemd-analyze");
            let verified = command.args(["verify", "--man=no"]).args([&service, &hip, &target]).output();
            let verified = verified.expect("it was there just now");
            let words = String::from_utf8_lossy(&verified.stderr);
            // Warnings are about other units of this machine, or name these files.
            let is_named = words.lines().any(|line| line.contains("sinew-"));
            assert!(verified.status.success() && !is_named, "{words}\n{text}");
        }
    }
}
