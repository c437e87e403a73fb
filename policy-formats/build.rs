//! Passes on the rpath of a MuJoCo outside the system's library path.
//!
//! Cargo applies link arguments only to the package whose build script prints them, so that every package with a
//! binary, test, example or benchmark (this one, `learn`, `cli`) runs this script.

fn main() {
    println!("cargo::rerun-if-env-changed=DEP_MUJOCO_RS_RPATH");
    if let Ok(rpath) = std::env::var("DEP_MUJOCO_RS_RPATH") {
        println!("cargo::rustc-link-arg=-Wl,-rpath,{rpath}");
    }
}
