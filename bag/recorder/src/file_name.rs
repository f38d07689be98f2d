//! The name of a recording's file.

use std::{
    ffi::OsStr,
    path::{Path, PathBuf},
    time::{Duration, UNIX_EPOCH},
};

/// The name of a recording without a path.
const DEFAULT: &str = "{node}-{time}.mcap";
/// The place of the time in a path.
const TIME: &str = "{time}";

/// Returns the path with the name of the node in place of `{node}`, and with the time in UTC in place of `{time}`, as
/// in `knee-2026-01-31-093000.mcap`. Without a path this is the file in the current folder.
pub(crate) fn filled(path: Option<&Path>, node: &str, wall_ns: u64) -> PathBuf {
    let path = path.unwrap_or_else(|| Path::new(DEFAULT));
    // A path that is no text has no placeholders.
    let Some(text) = path.to_str() else { return path.to_owned() };
    let letter = |c: char| if c.is_ascii_alphanumeric() || "-_.".contains(c) { c } else { '_' };
    let node: String = node.trim_start_matches('.').chars().map(letter).collect();
    PathBuf::from(text.replace("{node}", &node).replace(TIME, &time(wall_ns)))
}

/// Returns whether the time is in the name of the file.
pub(crate) fn has_time(path: Option<&Path>) -> bool {
    path.and_then(|path| path.to_str()).unwrap_or(DEFAULT).contains(TIME)
}

/// Returns the path with a number before its ending, as in `knee-2026-01-31-093000-2.mcap`; for 1 the path itself.
pub(crate) fn numbered(path: &Path, number: u32) -> PathBuf {
    if number <= 1 {
        return path.to_owned();
    }
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push(format!("-{number}"));
    if let Some(ending) = path.extension() {
        name.push(".");
        name.push(ending);
    }
    path.with_file_name(name)
}

/// Returns the path with `-{time}` before its ending, unless `{time}` is in it.
pub(crate) fn timed(path: &Path) -> PathBuf {
    if path.to_string_lossy().contains(TIME) {
        return path.to_owned();
    }
    let mut name = path.file_stem().unwrap_or_default().to_owned();
    name.push("-{time}.");
    name.push(path.extension().unwrap_or_else(|| OsStr::new("mcap")));
    path.with_file_name(name)
}

fn time(wall_ns: u64) -> String {
    let at = UNIX_EPOCH.checked_add(Duration::from_nanos(wall_ns)).unwrap_or(UNIX_EPOCH);
    let time = humantime::format_rfc3339_seconds(at).to_string().replace(':', "").replace('T', "-");
    time.trim_end_matches('Z').to_owned()
}

#[cfg(test)]
mod tests {
    use super::*;

    const AT_NS: u64 = 1_769_852_640_000_000_000;

    #[test]
    fn file_is_named_by_node_and_time() {
        assert_eq!(filled(None, "leg/knee", AT_NS), Path::new("leg_knee-2026-01-31-094400.mcap"));
        let path = Path::new("/var/log/{node}/{time}.mcap");
        assert_eq!(filled(Some(path), "knee", AT_NS), Path::new("/var/log/knee/2026-01-31-094400.mcap"));
    }

    #[test]
    fn each_start_has_a_file_of_its_own() {
        assert_eq!(timed(Path::new("/var/log/{node}.mcap")), Path::new("/var/log/{node}-{time}.mcap"));
        assert_eq!(timed(Path::new("walk")), Path::new("walk-{time}.mcap"));
        assert_eq!(timed(Path::new("{time}/walk.mcap")), Path::new("{time}/walk.mcap"));
    }

    #[test]
    fn number_stands_before_the_ending() {
        let path = Path::new("/var/log/knee.mcap");
        assert_eq!(numbered(path, 1), path);
        assert_eq!(numbered(path, 2), Path::new("/var/log/knee-2.mcap"));
        assert_eq!(numbered(Path::new("walk"), 3), Path::new("walk-3"));
        let with_time = [None, Some(Path::new("{time}.mcap")), Some(Path::new("walk.mcap"))].map(has_time);
        assert_eq!(with_time, [true, true, false]);
    }

    #[test]
    fn name_of_a_node_leaves_no_folder() {
        let path = Path::new("/var/log/{node}.mcap");
        assert_eq!(filled(Some(path), "../../etc/knee", AT_NS), Path::new("/var/log/_.._etc_knee.mcap"));
        assert_eq!(filled(Some(Path::new("walk.mcap")), "knee", AT_NS), Path::new("walk.mcap"));
    }
}
