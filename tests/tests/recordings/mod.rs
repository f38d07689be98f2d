//! A recording of this host's node, while its recorder, its disk or its node fails.

mod faults;
mod load;

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use serde_json::Value;
use sinew_testkit::TestDirectory;
use sinew_tests::recording::sinew;

/// A file system of this size in memory, until the end of the test.
struct SmallDisk {
    folder: PathBuf,
    is_mounted: bool,
    _directory: TestDirectory,
}

impl SmallDisk {
    /// `None`, with a printed reason, if none can be mounted: that takes root.
    fn mount(options: &str) -> Option<Self> {
        let directory = TestDirectory::new();
        let folder = directory.join("disk");
        std::fs::create_dir(&folder).expect("the test's own directory");
        let output =
            Command::new("mount").args(["-t", "tmpfs", "-o", options, "tmpfs"]).arg(&folder).output();
        let failure = match &output {
            Ok(output) if output.status.success() => None,
            Ok(output) => Some(String::from_utf8_lossy(&output.stderr).trim().to_owned()),
            Err(error) => Some(error.to_string()),
        };
        if let Some(reason) = &failure {
            println!("skipped: no file system can be mounted: {reason}");
        }
        let disk = Self { folder, is_mounted: failure.is_none(), _directory: directory };
        disk.is_mounted.then_some(disk)
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        if self.is_mounted {
            // A busy one stays, and so does its folder; the next boot removes both.
            let _ = Command::new("umount").arg(&self.folder).output();
        }
    }
}

/// `sinew bag check FILE --json`: its exit code and its JSON.
fn check(file: &Path) -> (Option<i32>, Value) {
    let output = sinew().args(["bag", "check", "--json"]).arg(file).output().expect("it starts");
    let text = String::from_utf8_lossy(&output.stdout);
    let json = serde_json::from_str(&text).unwrap_or_else(|error| panic!("{error}: {text}"));
    (output.status.code(), json)
}
