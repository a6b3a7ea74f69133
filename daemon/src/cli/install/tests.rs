//! Installing below a folder: what is there, twice, changed, taken away.

use super::*;
use crate::files::SessionsConfig;
use crate::live::LiveConfig;
use clap::Parser;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

#[derive(Parser)]
struct Line {
    #[command(flatten)]
    into: Target,
}

fn into(root: &Path, more: &[&str]) -> Target {
    let fixed = ["gv3", "--root", root.to_str().unwrap()];
    Line::try_parse_from(fixed.iter().chain(more)).unwrap().into
}

fn install(root: &Path, more: &[&str]) -> String {
    into(root, more).install(b"program".to_vec()).unwrap().report
}

/// Paths of all files below a folder.
fn files(folder: &Path) -> Vec<String> {
    fn collect(root: &Path, folder: &Path, found: &mut Vec<String>) {
        for entry in std::fs::read_dir(folder).unwrap() {
            let path = entry.unwrap().path();
            match path.is_dir() {
                true => collect(root, &path, found),
                false => found.push(path.strip_prefix(root).unwrap().to_string_lossy().into_owned()),
            }
        }
    }
    let mut found = Vec::new();
    collect(folder, folder, &mut found);
    found.sort();
    found
}

#[test]
fn a_dry_run_shows_everything_and_does_nothing() {
    let root = tempfile::tempdir().unwrap();
    let dry = install(root.path(), &["--dry-run"]);
    for path in
        ["usr/local/bin/gv3", "etc/systemd/system/gv3.service", "etc/gv3/rig.toml", "share/man/man1/gv3-serve.1"]
    {
        assert!(
            dry.contains(&format!("would write {}", root.path().join("").display())) && dry.contains(path),
            "{dry}"
        );
    }
    assert!(files(root.path()).is_empty());
    // For the machine itself, with what to do next.
    let own = Line::try_parse_from(["gv3", "--dry-run"]).unwrap().into.install(Vec::new()).unwrap().report;
    assert!(own.contains(" /etc/systemd/system/gv3.service") && own.contains("systemctl enable --now gv3"), "{own}");
}

#[test]
fn what_is_installed_is_complete_and_stays_untouched_the_second_time() {
    let root = tempfile::tempdir().unwrap();
    assert!(!install(root.path(), &["--prefix", "/opt/gv3"]).contains("already"));
    let at = |path: &str| root.path().join(path);
    assert_eq!(std::fs::read(at("opt/gv3/bin/gv3")).unwrap(), b"program");
    assert_eq!(std::fs::metadata(at("opt/gv3/bin/gv3")).unwrap().permissions().mode() & 0o777, 0o755);
    let unit = std::fs::read_to_string(at("etc/systemd/system/gv3.service")).unwrap();
    assert!(unit.contains("\nExecStart=/opt/gv3/bin/gv3 serve --config %E/gv3/rig.toml") && !unit.contains("@BIN@"));
    let rig = LiveConfig::read(&at("etc/gv3/rig.toml")).unwrap();
    assert_eq!(rig.sessions.keep_days, SessionsConfig::default().keep_days);
    let before = files(root.path());
    assert!(before.contains(&"etc/udev/rules.d/70-gv3.rules".to_owned()), "{before:?}");
    assert!(before.contains(&"opt/gv3/share/bash-completion/completions/gv3".to_owned()), "{before:?}");
    let again = install(root.path(), &["--prefix", "/opt/gv3"]);
    assert!(again.lines().all(|line| line.ends_with("already as it should be")), "{again}");
    assert_eq!(files(root.path()), before);
}

#[test]
fn older_files_are_replaced_and_an_edited_rig_is_kept() {
    let root = tempfile::tempdir().unwrap();
    install(root.path(), &[]);
    let at = |path: &str| root.path().join(path);
    std::fs::write(at("etc/gv3/rig.toml"), "# mine").unwrap();
    std::fs::write(at("usr/local/bin/gv3"), "older").unwrap();
    std::fs::set_permissions(at("etc/udev/rules.d/70-gv3.rules"), std::fs::Permissions::from_mode(0o600)).unwrap();
    let report = install(root.path(), &["--json"]);
    let report: serde_json::Value = serde_json::from_str(&report).unwrap();
    let change = |path: &str| {
        let path = at(path);
        let file = report["files"].as_array().unwrap().iter().find(|f| f["path"] == path.to_str().unwrap());
        file.unwrap()["change"].as_str().unwrap().to_owned()
    };
    assert_eq!(change("etc/gv3/rig.toml"), "kept");
    assert_eq!(change("usr/local/bin/gv3"), "replaced");
    assert_eq!(change("etc/udev/rules.d/70-gv3.rules"), "replaced");
    assert_eq!(change("etc/systemd/system/gv3.service"), "unchanged");
    assert_eq!(std::fs::read(at("usr/local/bin/gv3")).unwrap(), b"program");
    // What is taken away is what was put there.
    let gone = into(root.path(), &[]).uninstall().unwrap().report;
    assert!(gone.contains("rig.toml: kept, it is yours") && gone.contains("gv3.service: removed"), "{gone}");
    assert_eq!(files(root.path()), ["etc/gv3/rig.toml"]);
    let nothing = into(root.path(), &[]).uninstall().unwrap().report;
    assert!(nothing.contains("bin/gv3: not there"), "{nothing}");
}

#[test]
fn one_users_installation_stays_in_the_home_and_leaves_the_machine_alone() {
    let root = tempfile::tempdir().unwrap();
    let config = Some("/home/me/conf".into());
    let places = Places::user(root.path().into(), None, Path::new("/home/me"), config);
    let paths: Vec<PathBuf> = places.files(Vec::new()).unwrap().into_iter().map(|f| f.path).collect();
    let home = root.path().join("home/me");
    assert!(paths.iter().all(|path| path.starts_with(&home)), "{paths:?}");
    assert!(paths.contains(&home.join("conf/systemd/user/gv3.service")), "{paths:?}");
    assert!(paths.contains(&home.join(".local/bin/gv3")), "{paths:?}");
    assert!(!paths.iter().any(|path| path.to_string_lossy().contains("rules.d")), "{paths:?}");
}

#[test]
fn what_cannot_work_is_named_before_anything_is_done() {
    let root = tempfile::tempdir().unwrap();
    let relative = into(root.path(), &["--prefix", "opt"]).install(Vec::new()).unwrap_err();
    assert!(relative.to_string().contains("absolute"), "{relative}");
    let strange = into(root.path(), &["--prefix", "/a b%"]).install(Vec::new()).unwrap_err();
    assert!(strange.to_string().contains("cannot name this path"), "{strange}");
    std::fs::create_dir_all(root.path().join("etc/gv3/rig.toml")).unwrap();
    let folder = into(root.path(), &[]).install(Vec::new()).unwrap_err();
    assert!(format!("{folder:#}").contains("rig.toml: cannot read"), "{folder:#}");
    assert!(files(root.path()).is_empty());
}
