//! A node's files: the errors for a missing, exposed or expired one, and for one of another node.

use std::{
    fs::{self, Permissions},
    os::unix::fs::PermissionsExt,
    path::Path,
};

use crate::{
    Credentials, CredentialsError, TimePolicy, files as names,
    testing::{Authority, CertificateContent, DAY, Directory, NOW, at, identity},
};

fn load(directory: &Directory, policy: TimePolicy, now: u64) -> Result<Credentials, CredentialsError> {
    Credentials::load(directory.path(), &identity("hip", 11), policy, at(now))
}

/// The faults of the hip's directory, changed so.
fn faults(change: impl FnOnce(&Authority, &Directory)) -> Vec<String> {
    let walker = Authority::new("walker");
    let directory = walker.directory(&CertificateContent::of(&identity("hip", 11)));
    change(&walker, &directory);
    let faults = load(&directory, TimePolicy::Strict, NOW).expect_err("it has a fault");
    faults.faults().iter().map(ToString::to_string).collect()
}

/// Asserts that there is exactly one fault, and that it contains these parts.
#[track_caller]
fn only(faults: &[String], parts: &[&str]) {
    assert_eq!(faults.len(), 1, "{faults:?}");
    for part in parts {
        assert!(faults[0].contains(part), "{part}: {}", faults[0]);
    }
}

#[test]
fn valid_files_load_with_their_identity() {
    let walker = Authority::new("walker");
    let directory = walker.directory(&CertificateContent::of(&identity("hip", 11)));
    let credentials = load(&directory, TimePolicy::Strict, NOW).unwrap();
    assert_eq!((credentials.identity(), credentials.warnings().len()), (&identity("hip", 11), 0));
    assert_eq!(*credentials.discovery().text(), *walker.discovery.text());
    assert_eq!(credentials.validity().until, at(NOW + 365 * DAY));
    let shown = format!("{credentials:?}");
    assert!(shown.contains("\"hip\"") && !shown.contains("PRIVATE"), "{shown}");
}

#[test]
fn all_missing_files_are_named_together() {
    let walker = Authority::new("walker");
    let directory = walker.directory(&CertificateContent::of(&identity("hip", 11)));
    let all =
        [names::NODE_CERTIFICATE, names::NODE_KEY, names::AUTHORITY, names::DISCOVERY_KEY, names::DENIED];
    for name in all {
        fs::remove_file(directory.path().join(name)).unwrap();
    }
    let text = load(&directory, TimePolicy::Strict, NOW).unwrap_err().to_string();
    assert_eq!(text.lines().count(), 5, "{text}");
    for name in all {
        assert!(text.contains(name) && text.contains("sinew keys"), "{text}");
    }
    let nowhere = Credentials::load(
        &directory.path().join("nowhere"),
        &identity("hip", 11),
        TimePolicy::Strict,
        at(NOW),
    );
    assert!(nowhere.unwrap_err().to_string().contains("nowhere: No such file"));
}

#[test]
fn secret_readable_by_others_is_refused() {
    for name in [names::NODE_KEY, names::DISCOVERY_KEY] {
        for mode in [0o640, 0o604, 0o620, 0o601] {
            let found = faults(|_, directory| {
                fs::set_permissions(directory.path().join(name), Permissions::from_mode(mode)).unwrap();
            });
            only(&found, &[name, &format!("{mode:04o}"), "chmod 600"]);
        }
    }
}

#[test]
fn file_writable_by_others_is_refused() {
    for name in [names::NODE_CERTIFICATE, names::AUTHORITY, names::DENIED, "."] {
        for mode in [0o764, 0o746, 0o722] {
            let found = faults(|_, directory| {
                fs::set_permissions(directory.path().join(name), Permissions::from_mode(mode)).unwrap();
            });
            only(&found, &["others can write to", "chmod go-w"]);
        }
    }
}

#[test]
fn access_list_in_shared_directory_is_refused() {
    let directory = Directory::new();
    let (common, link) = (directory.path().join("common"), directory.path().join("link.toml"));
    fs::create_dir(&common).unwrap();
    let list = common.join("access.toml");
    fs::write(&list, "").unwrap();
    fs::set_permissions(&list, Permissions::from_mode(0o644)).unwrap();
    std::os::unix::fs::symlink(&list, &link).unwrap();
    for (mode, is_taken) in [(0o755, true), (0o775, false), (0o1777, false)] {
        fs::set_permissions(&common, Permissions::from_mode(mode)).unwrap();
        // By its own name, and by a link in a directory that is the node's own.
        for path in [&list, &link] {
            let read = names::access_list(path, 1 << 20);
            assert_eq!(read.is_ok(), is_taken, "{mode:o} {}: {read:?}", path.display());
            if let Err(why) = read {
                only(&[why.to_string()], &["others can write to", "common"]);
            }
        }
    }
}

#[test]
fn every_link_to_access_list_must_be_protected() {
    // Given: `link.toml`, which leads to `middle/link.toml`, and that to `list/access.toml`
    let directory = Directory::new();
    let [link, middle, list] = ["link.toml", "middle", "list"].map(|name| directory.path().join(name));
    for made in [&middle, &list] {
        fs::create_dir(made).unwrap();
        fs::set_permissions(made, Permissions::from_mode(0o755)).unwrap();
    }
    fs::write(list.join("access.toml"), "text").unwrap();
    fs::set_permissions(list.join("access.toml"), Permissions::from_mode(0o644)).unwrap();
    std::os::unix::fs::symlink("middle/link.toml", &link).unwrap();
    std::os::unix::fs::symlink("../list/access.toml", middle.join("link.toml")).unwrap();
    assert_eq!(names::access_list(&link, 1 << 20).unwrap().as_slice(), b"text");
    for weak in [&middle, &list] {
        // When
        fs::set_permissions(weak, Permissions::from_mode(0o777)).unwrap();
        // Then
        let read = names::access_list(&link, 1 << 20);
        let name = weak.file_name().unwrap().to_str().unwrap();
        only(&[read.unwrap_err().to_string()], &["others can write to", name]);
        fs::set_permissions(weak, Permissions::from_mode(0o755)).unwrap();
    }
    // A ring of links has an end.
    fs::remove_file(middle.join("link.toml")).unwrap();
    std::os::unix::fs::symlink(&link, middle.join("link.toml")).unwrap();
    only(&[names::access_list(&link, 1 << 20).unwrap_err().to_string()], &["link.toml", "symbolic links"]);
}

#[test]
fn access_list_that_is_no_file_does_not_block() {
    let directory = Directory::new();
    let pipe = directory.path().join("access.toml");
    let mode = rustix::fs::Mode::from_raw_mode(0o600);
    rustix::fs::mknodat(rustix::fs::CWD, &pipe, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    only(&[names::access_list(&pipe, 1 << 20).unwrap_err().to_string()], &["is no file"]);
    for path in [directory.path(), Path::new("/"), Path::new("..")] {
        assert!(names::access_list(path, 1 << 20).is_err(), "{}", path.display());
    }
}

#[test]
fn path_that_is_no_file_does_not_block() {
    for name in [names::NODE_KEY, names::AUTHORITY] {
        let found = faults(|_, directory| {
            let path = directory.path().join(name);
            fs::remove_file(&path).unwrap();
            rustix::fs::mknodat(
                rustix::fs::CWD,
                &path,
                rustix::fs::FileType::Fifo,
                rustix::fs::Mode::from_raw_mode(0o600),
                0,
            )
            .unwrap();
        });
        only(&found, &[name, "is no file"]);
    }
    let found = faults(|_, directory| directory.put(names::NODE_KEY, 0o600, &"k".repeat(17 << 10)));
    only(&found, &[names::NODE_KEY, "more than 16384 bytes"]);
}

#[test]
fn wrong_file_content_is_reported() {
    let cases: [(&str, u32, &str, &str); 7] = [
        (names::NODE_CERTIFICATE, 0o644, "", "no certificate in PEM"),
        (
            names::NODE_CERTIFICATE,
            0o644,
            "-----BEGIN CERTIFICATE-----\nAAAA\n-----END CERTIFICATE-----\n",
            "no certificate",
        ),
        (names::NODE_KEY, 0o600, "hello", "no key"),
        (names::NODE_KEY, 0o600, "-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n", "no key"),
        (names::DISCOVERY_KEY, 0o600, "00", "64 hexadecimal digits"),
        (names::DENIED, 0o644, "# ok\nhip\n", "line 2 is \"hip\""),
        (names::AUTHORITY, 0o644, "-----BEGIN CERTIFICATE-----\n", "PEM"),
    ];
    for (name, mode, text, part) in cases {
        let found = faults(|_, directory| directory.put(name, mode, text));
        only(&found, &[name, part]);
    }
    let twice = faults(|walker, directory| {
        directory.put(names::AUTHORITY, 0o644, &[walker.pem.as_str(), &walker.pem].concat());
    });
    only(&twice, &["more than one certificate"]);
}

#[test]
fn mismatched_files_are_reported() {
    let found = faults(|walker, directory| {
        let other = walker.sign(&CertificateContent::of(&identity("hip", 11)));
        directory.put(names::NODE_KEY, 0o600, &other.key);
    });
    only(&found, &["is not the key of", names::NODE_CERTIFICATE]);
    let found = faults(|_, directory| {
        directory.put(names::AUTHORITY, 0o644, &Authority::new("walker").pem);
    });
    only(&found, &["is not from the authority", "another authority signed it"]);
    let found = faults(|_, directory| {
        directory.put(names::AUTHORITY, 0o644, &Authority::new("runner").pem);
    });
    only(&found, &["project \"runner\"", "node.project"]);
    let found = faults(|walker, directory| {
        let leaf = walker.sign(&CertificateContent::of(&identity("hip", 11))).certificate;
        directory.put(names::AUTHORITY, 0o644, &leaf);
    });
    only(&found, &["no certificate of a project's authority"]);
}

#[test]
fn files_of_another_node_are_refused_with_both_names() {
    let walker = Authority::new("walker");
    for other in [identity("knee", 12), identity("hip", 12), identity("knee", 11)] {
        let directory = walker.directory(&CertificateContent::of(&other));
        let found = load(&directory, TimePolicy::Strict, NOW).unwrap_err();
        let text: Vec<_> = found.faults().iter().map(ToString::to_string).collect();
        let (whose, here) = (other.to_string(), identity("hip", 11).to_string());
        only(&text, &[&whose, &here, "sinew keys issue hip=192.168.0.11"]);
    }
}

#[test]
fn own_certificate_expiry_and_revocation_are_reported() {
    let walker = Authority::new("walker");
    let content = CertificateContent {
        from: NOW - 2 * DAY,
        until: NOW - DAY,
        ..CertificateContent::of(&identity("hip", 11))
    };
    let directory = walker.directory(&content);
    let text = load(&directory, TimePolicy::UntilSet, NOW).unwrap_err().to_string();
    assert!(text.contains("it ended on 2026-11-21") && text.contains("sinew keys issue"), "{text}");
    // Ignored: it is accepted, with a warning
    let credentials = load(&directory, TimePolicy::Ignored, NOW).unwrap();
    assert!(credentials.warnings()[0].contains("not looked at"));
    let serial = credentials.serial().to_string();
    let directory = walker.directory(&CertificateContent::of(&identity("hip", 11)));
    directory.put(names::DENIED, 0o644, &serial);
    assert!(load(&directory, TimePolicy::Strict, NOW).is_ok(), "another one's");
    let own = load(&directory, TimePolicy::Strict, NOW).unwrap().serial().to_string();
    directory.put(names::DENIED, 0o644, &own);
    let text = load(&directory, TimePolicy::Ignored, NOW).unwrap_err().to_string();
    assert!(text.contains(&own) && text.contains("is revoked"), "{text}");
}

#[test]
fn unset_clock_and_near_expiry_warn() {
    let walker = Authority::new("walker");
    let directory = walker.directory(&CertificateContent::of(&identity("hip", 11)));
    let words =
        |policy, now| load(&directory, policy, now).map(|credentials| credentials.warnings().to_vec());
    let warned = words(TimePolicy::UntilSet, 12).unwrap();
    assert!(
        warned[0].contains("1970-01-01T00:00:12Z") && warned[0].contains("the clock is not set"),
        "{warned:?}"
    );
    let refused = words(TimePolicy::Strict, 12).unwrap_err().to_string();
    assert!(refused.contains("the clock is not set"), "{refused}");
    let soon = words(TimePolicy::UntilSet, NOW + 340 * DAY).unwrap();
    assert!(soon[0].contains("ends on 2027-11-22"), "{soon:?}");
}
