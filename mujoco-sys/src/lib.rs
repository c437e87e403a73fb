//! Raw bindings to MuJoCo 2.2, made by bindgen from the installed headers, and a small C shim (`shim/shim.c`) that
//! turns `mju_error` into a return value.
//!
//! Nothing here is safe to call by itself and nothing here is documented beyond MuJoCo's own reference:
//! use the `mujoco-rs` crate.

#![allow(non_camel_case_types, non_snake_case, non_upper_case_globals)]
#![allow(clippy::all)]

include!(concat!(env!("OUT_DIR"), "/bindings.rs"));

#[cfg(test)]
mod layout {
    //! bindgen reads the headers through libclang; the library was compiled by another compiler. The shim, compiled
    //! by the system's own, says where every field lies, and both must agree.

    include!(concat!(env!("OUT_DIR"), "/layout.rs"));

    #[test]
    fn sizes_and_offsets_agree_with_the_c_compiler() {
        assert!(RUST_LAYOUT.len() > 700, "the list of fields has only {} entries", RUST_LAYOUT.len());
        for scalar in
            ["mjvScene.ngeom", "mjvGeom.objid", "mjContact.dist", "mjVisual.quality.shadowsize", "mjData.ncon"]
        {
            assert!(RUST_LAYOUT.iter().any(|(name, _)| *name == scalar), "{scalar} is not in the list of fields");
        }
        for (index, (name, rust)) in RUST_LAYOUT.iter().enumerate() {
            let c = unsafe { super::mjshim_layout(index as i32) };
            assert_eq!(*rust as u64, c, "{name}: Rust has {rust}, the C compiler has {c}");
        }
        assert_eq!(unsafe { super::mjshim_layout(RUST_LAYOUT.len() as i32) }, u64::MAX);
    }

    #[test]
    fn library_is_the_version_of_the_headers() {
        assert_eq!(unsafe { super::mj_version() }, super::mjVERSION_HEADER as i32);
    }
}
