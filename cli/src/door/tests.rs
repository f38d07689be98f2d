//! Which of the sockets that were found are asked.

use std::os::unix::{
    fs::{chown, lchown, symlink},
    net::UnixListener,
};

use sinew_tests::OwnDirectory;

use super::*;

/// A user that is neither root nor this one; no account needs to have it.
const STRANGER: u32 = 54_321;

/// Whether files can be given to another user here.
fn can_give_away() -> bool {
    let can = rustix::process::geteuid().is_root();
    if !can {
        println!("skipped: only root can give a file to another user");
    }
    can
}

fn place(directory: &OwnDirectory) -> Place {
    Place { directory: directory.join(""), prefix: "sinew-" }
}

/// Somebody who listens there, and says nothing.
fn listens(path: &Path) -> UnixListener {
    let listener = UnixListener::bind(path).expect("the test's own directory");
    listener.set_nonblocking(true).expect("it is a socket");
    listener
}

fn was_asked(listener: &UnixListener) -> bool {
    listener.accept().is_ok()
}

#[test]
fn the_first_socket_of_ones_own_that_takes_us_is_entered_and_each_that_does_not_is_named() {
    let directory = OwnDirectory::new();
    fs::write(directory.join("sinew-a\u{1b}[2J.sock"), "").expect("the test's own directory");
    let find = || find_at(vec![place(&directory)], own_uid());
    let seen = find().expect_err("nobody listens");
    assert!(seen.contains("sinew-a\\u{1b}[2J.sock: "), "{seen}");
    assert!(!seen.contains('\u{1b}'), "what terminals obey is not shown");
    let listener = listens(&directory.join("sinew-b.sock"));
    let (path, _) = find().expect("it is ours");
    assert!(path.ends_with("sinew-b.sock") && was_asked(&listener));
}

#[test]
fn a_place_with_nothing_in_it_is_named() {
    let directory = OwnDirectory::new();
    let seen = find_at(vec![place(&directory)], own_uid()).expect_err("nothing is there");
    assert!(seen.contains("sinew-*.sock: nothing there"), "{seen}");
}

#[test]
fn a_socket_of_another_user_that_was_found_is_named_and_not_asked() {
    if !can_give_away() {
        return;
    }
    let directory = OwnDirectory::new();
    let path = directory.join("sinew-0.sock");
    let theirs = listens(&path);
    chown(&path, Some(STRANGER), None).expect("root may");
    let find = || find_at(vec![place(&directory)], own_uid());
    // When: there is no other. Then:
    let seen = find().expect_err("it is not ours");
    let words = "sinew-0.sock belongs to uid 54321: not asked; name it with --socket to ask it all the same";
    assert!(seen.contains(words), "{seen}");
    // When: there is one of one's own behind it. Then:
    let ours = listens(&directory.join("sinew-1.sock"));
    let (found, _) = find().expect("it is ours");
    assert!(found.ends_with("sinew-1.sock") && was_asked(&ours));
    // When: others than that are looked for. Then:
    let others = |named: &[PathBuf]| others_at(&found, named, std::iter::once(place(&directory)), own_uid());
    let found_alone = others(&[]);
    assert!(found_alone.doors.is_empty() && !was_asked(&theirs), "it was asked nothing in all this");
    assert!(
        matches!(&found_alone.left_out[..], [words] if words.contains("54321") && words.contains("--other-socket")),
        "{:?}",
        found_alone.left_out
    );
    // When: it is named. Then:
    let named = others(std::slice::from_ref(&path));
    assert!(named.doors.len() == 1 && named.left_out.is_empty() && was_asked(&theirs));
}

#[test]
fn a_link_is_asked_if_it_and_what_it_stands_for_are_ones_own() {
    if !can_give_away() {
        return;
    }
    let (directory, elsewhere) = (OwnDirectory::new(), OwnDirectory::new());
    let [ours, theirs] = ["ours.sock", "theirs.sock"].map(|name| elsewhere.join(name));
    let (_ours, _theirs) = (listens(&ours), listens(&theirs));
    chown(&theirs, Some(STRANGER), None).expect("root may");
    for (name, target, is_ours) in
        [("sinew-0.sock", &ours, false), ("sinew-1.sock", &theirs, true), ("sinew-2.sock", &ours, true)]
    {
        let link = directory.join(name);
        symlink(target, &link).expect("the test's own directory");
        if !is_ours {
            lchown(&link, Some(STRANGER), None).expect("root may");
        }
    }
    let found = Found::at(&place(&directory), own_uid());
    let names = |paths: &[PathBuf]| paths.iter().map(|path| shown(path)).collect::<String>();
    assert!(found.own.len() == 1 && names(&found.own).ends_with("sinew-2.sock"), "{found:?}");
    assert_eq!(found.left_out.iter().map(|one| one.uid).collect::<Vec<_>>(), [STRANGER; 2]);
}

#[test]
fn one_user_with_more_sockets_than_are_tried_hides_none_of_ones_own() {
    if !can_give_away() {
        return;
    }
    let directory = OwnDirectory::new();
    for number in 0..SOCKETS_MAX + LEFT_OUT_MAX {
        let path = directory.join(&format!("sinew-{number}.sock"));
        fs::write(&path, "").expect("the test's own directory");
        chown(&path, Some(STRANGER), None).expect("root may");
    }
    let nobody = find_at(vec![place(&directory)], own_uid()).expect_err("all are theirs");
    assert!(nobody.contains("64 more there belong to others: not asked"), "{nobody}");
    assert_eq!(nobody.matches("belongs to uid 54321").count(), LEFT_OUT_MAX);
    let _ours = listens(&directory.join("sinew-ours.sock"));
    let (path, _) = find_at(vec![place(&directory)], own_uid()).expect("it is ours");
    assert!(path.ends_with("sinew-ours.sock"));
}

#[test]
fn when_the_time_for_all_that_were_found_is_over_no_more_are_asked() {
    let directory = OwnDirectory::new();
    let path = directory.join("sinew-0.sock");
    let listener = listens(&path);
    let why = ask(&path, Time::ZERO).expect_err("no time is left");
    assert!(why.contains("not asked") && !was_asked(&listener), "{why}");
}
