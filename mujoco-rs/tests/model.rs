//! Compiling, naming and patching models.

use mujoco_rs::{Assets, BodyId, CameraId, Data, Error, GeomId, Integrator, JointId, Model, ObjectKind};
use proptest::prelude::*;

const SCENE: &str = r#"<mujoco>
  <option timestep="0.005" integrator="RK4" gravity="0 0 -9.81" density="1.2" viscosity="1.8e-5"/>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 1"/>
    <camera name="eye" pos="0 0 1"/>
    <body name="a" pos="0 0 1"><freejoint name="a_joint"/><geom name="a_geom" size=".1" mass="2"/></body>
    <body name="b" pos="1 0 1"><joint name="hinge" type="hinge"/><geom size=".1" mass="3"/></body>
  </worldbody>
</mujoco>"#;

#[test]
fn sizes_names_and_options_are_those_of_the_scene() {
    let model = Model::from_xml(SCENE).unwrap();
    assert_eq!((model.nbody(), model.nq(), model.nv()), (3, 8, 7));
    assert_eq!(model.timestep(), 0.005);
    assert_eq!(model.gravity(), [0.0, 0.0, -9.81]);
    assert_eq!((model.density(), model.viscosity()), (1.2, 1.8e-5));
    assert_eq!(model.integrator(), Some(Integrator::Rk4));
    assert_eq!(model.count(ObjectKind::Camera), 1);

    let a: BodyId = model.find("a").unwrap();
    assert_eq!(model.name(a), Some("a"));
    assert_eq!(model.body_mass()[a.index()], 2.0);
    let hinge: JointId = model.find("hinge").unwrap();
    assert_eq!(model.jnt_qposadr()[hinge.index()], 7);
    assert!(model.find::<CameraId>("eye").is_ok());
    let b: BodyId = model.find("b").unwrap();
    let nameless = (0..model.ngeom()).filter(|&g| model.geom_bodyid()[g] == b.index() as i32).count();
    assert_eq!(nameless, 1);
}

#[test]
fn an_unknown_name_is_an_error_that_says_kind_and_name() {
    let model = Model::from_xml(SCENE).unwrap();
    let error = model.find::<GeomId>("a").unwrap_err();
    assert_eq!(error, Error::UnknownName { kind: ObjectKind::Geom, name: "a".into() });
    assert_eq!(error.to_string(), "no geom named `a` in the model");
    assert!(model.find::<GeomId>("zero\0byte").is_err());
    assert!(model.find::<GeomId>("").is_err());
}

#[test]
fn every_array_has_the_length_that_mujoco_allocates() {
    let model = Model::from_xml(SCENE).unwrap();
    assert_eq!(model.qpos0().len(), 8);
    assert_eq!(model.body_inertia().len(), 9);
    assert_eq!(model.geom_solimp().len(), model.ngeom() * 5);
    assert_eq!(model.names().len(), model.nnames());
    assert_eq!(model.key_qpos().len(), 0);
    let data = Data::new(model).unwrap();
    assert_eq!(data.xfrc_applied().len(), 18);
    assert_eq!(data.efc_AR().len(), data.model().njmax() * data.model().njmax());
    assert_eq!(data.efc_J().len(), data.model().njmax() * 7);
}

#[test]
fn malformed_scenes_are_errors_with_mujocos_own_message() {
    let message = |xml: &str| Model::from_xml(xml).unwrap_err().to_string();
    assert!(message("<mujoco><worldbody>").contains("XML"), "{}", message("<mujoco><worldbody>"));
    assert!(message("").contains("empty"));
    assert!(message("<mujoco><worldbody><nosuch/></worldbody></mujoco>").contains("nosuch"));
    assert!(message("<mujoco><worldbody><geom size='-1'/></worldbody></mujoco>").contains("size"));
    let no_mass = "<mujoco><worldbody><body><freejoint/></body></worldbody></mujoco>";
    assert!(message(no_mass).contains("mass"), "{}", message(no_mass));
    for xml in ["<mujoco/", "not xml", "<a/>"] {
        let text = message(xml);
        assert!(!text.contains('\n') && text.len() > 10, "{text:?}");
    }
}

#[test]
fn assets_in_memory_are_used_and_bad_ones_refused() {
    let xml = r#"<mujoco><asset><mesh name="m" file="tetra.obj"/></asset>
        <worldbody><geom type="mesh" mesh="m"/></worldbody></mujoco>"#;
    let tetra = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n";
    let model = Model::from_xml_with_assets(xml, &Assets::new().with("tetra.obj", tetra)).unwrap();
    assert_eq!(model.nmesh(), 1);

    let refused = |name: &str, bytes: &[u8]| {
        let error = Model::from_xml_with_assets(xml, &Assets::new().with(name, bytes)).unwrap_err();
        assert!(matches!(error, Error::Asset { .. }), "{error}");
        error.to_string()
    };
    assert!(refused("", b"x").contains("0 bytes"));
    assert!(refused(&"x".repeat(2000), b"x").contains("2000 bytes"));
    assert!(refused("a/b.obj", b"x").contains("directory"));
    assert!(refused("tetra.obj", b"").contains("empty"));
    let twice = Assets::new().with("a.obj", "x").with("a.obj", "y");
    assert!(Model::from_xml_with_assets(xml, &twice).unwrap_err().to_string().contains("already"));
    let many = (0..2100).fold(Assets::new(), |assets, i| assets.with(format!("{i}.obj"), "x"));
    assert_eq!(many.len(), 2100);
    assert!(Model::from_xml_with_assets(xml, &many).unwrap_err().to_string().contains("more than"));
    let missing = Model::from_xml(xml).unwrap_err().to_string();
    assert!(missing.contains("tetra.obj"), "{missing}");
    let garbage = Model::from_xml_with_assets(xml, &Assets::new().with("tetra.obj", "garbage"));
    assert!(matches!(garbage, Err(Error::Load { .. })));
}

#[test]
fn errors_of_the_engine_beneath_the_parser_are_errors_and_leave_it_usable() {
    let long = format!("<mujoco><include file='{}'/></mujoco>", "x".repeat(1200));
    let error = Model::from_xml(&long).unwrap_err().to_string();
    assert!(error.contains("too long"), "{error}");
    let path = "d/".repeat(3000) + "scene.xml";
    assert!(matches!(Model::from_file(path), Err(Error::Load { .. })));
    let huge = "<mujoco><asset><hfield name='h' nrow='50000' ncol='50000' size='1 1 1 1'/></asset></mujoco>";
    assert!(Model::from_xml(huge).is_err());
    assert!(Model::from_xml(SCENE).is_ok(), "the parser's lock is free");
}

#[test]
fn files_are_loaded_by_path_and_missing_ones_named() {
    let path = std::env::temp_dir().join(format!("mujoco-rs-model-{}.xml", std::process::id()));
    std::fs::write(&path, SCENE).unwrap();
    assert_eq!(Model::from_file(&path).unwrap().nbody(), 3);
    std::fs::remove_file(&path).unwrap();
    let message = Model::from_file(&path).unwrap_err().to_string();
    assert!(message.starts_with(&path.display().to_string()) && message.contains("No such file"), "{message}");
}

#[test]
fn patching_a_copy_leaves_the_original_as_it_was() {
    let model = Model::from_xml(SCENE).unwrap();
    let mut copy = model.try_clone().unwrap();
    copy.patch().body_mass_mut()[1] = 5.0;
    copy.patch().set_timestep(0.001).unwrap();
    copy.patch().set_gravity([0.0, 0.0, -1.0]).unwrap();
    copy.patch().set_integrator(Integrator::Euler);
    assert_eq!((copy.body_mass()[1], model.body_mass()[1]), (5.0, 2.0));
    assert_eq!((copy.timestep(), model.timestep()), (0.001, 0.005));
    assert_eq!((copy.gravity()[2], copy.integrator()), (-1.0, Some(Integrator::Euler)));
    assert!(copy.patch().set_timestep(0.0).is_err());
    assert!(copy.patch().set_timestep(f64::NAN).is_err());
    assert!(copy.patch().set_gravity([0.0, f64::INFINITY, 0.0]).is_err());
}

#[test]
fn numbers_by_which_mujoco_finds_memory_are_checked_when_they_are_written() {
    let xml = "<mujoco><asset><hfield name='h' nrow='2' ncol='3' size='1 1 1 1'/></asset><worldbody>
        <geom name='box' type='box' size='.1 .1 .1'/><geom name='plane' type='plane' size='1 1 1'/>
        <geom type='hfield' hfield='h'/></worldbody></mujoco>";
    let mut model = Model::from_xml(xml).unwrap();
    let (cube, plane): (GeomId, GeomId) = (model.find("box").unwrap(), model.find("plane").unwrap());
    let mut patch = model.patch();
    for bad in [-0.1, 0.0, f64::NAN, f64::INFINITY, 1e-300, 1e11] {
        let error = patch.set_geom_size(cube, [0.1, bad, 0.1]).unwrap_err();
        assert!(error.to_string().starts_with(&format!("a geom's size is {bad}, expected ")), "{error}");
        assert!(patch.set_hfield_size(0, [1.0, 1.0, bad, 1.0]).is_err(), "{bad}");
    }
    for bad in [f64::NAN, f64::INFINITY, -1e11] {
        assert!(patch.set_geom_pos(cube, [0.0, bad, 0.0]).is_err());
        assert!(patch.set_geom_rbound(cube, bad).is_err());
        assert!(patch.set_geom_quat(cube, [1.0, bad, 0.0, 0.0]).is_err());
    }
    assert!(patch.set_geom_quat(cube, [2.0, 0.0, 0.0, 0.0]).is_err());
    assert!(patch.set_geom_quat(cube, [0.0; 4]).is_err());
    assert!(patch.set_geom_size(plane, [0.0, 0.0, 1.0]).is_ok(), "an infinite plane");
    assert!(patch.set_geom_size(plane, [-1.0, 0.0, 1.0]).is_err());
    let strange = mujoco_rs::ObjectId::new(7);
    assert_eq!(
        patch.set_geom_pos(strange, [0.0; 3]),
        Err(Error::NotOfModel { kind: ObjectKind::Geom, index: 7, count: 3 })
    );
    assert!(patch.set_hfield_size(1, [1.0; 4]).is_err());
    patch.set_geom_pos(cube, [1.0, 2.0, 3.0]).unwrap();
    patch.set_geom_quat(cube, [0.0, 1.0, 0.0, 0.0]).unwrap();
    patch.set_geom_size(cube, [0.2, 0.3, 0.4]).unwrap();
    patch.set_geom_rbound(cube, 0.6).unwrap();
    patch.set_hfield_size(0, [1.0, 2.0, 3.0, 4.0]).unwrap();
    let row = cube.index();
    assert_eq!(model.geom_pos()[3 * row..][..3], [1.0, 2.0, 3.0]);
    assert_eq!(model.geom_quat()[4 * row..][..4], [0.0, 1.0, 0.0, 0.0]);
    assert_eq!(model.geom_size()[3 * row..][..3], [0.2, 0.3, 0.4]);
    assert_eq!((model.geom_rbound()[row], model.hfield_size()), (0.6, &[1.0, 2.0, 3.0, 4.0][..]));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 300, ..ProptestConfig::default() })]

    /// Whatever bytes stand in a scene, the answer is a model or an error, never the end of the process.
    #[test]
    fn damaged_scenes_are_models_or_errors(cut in 0usize..SCENE.len(), at in 0usize..SCENE.len(), letter in 32u8..127) {
        let mut bytes = SCENE.as_bytes().to_vec();
        bytes[at] = letter;
        if let Ok(text) = std::str::from_utf8(&bytes[..cut]) {
            prop_assert!(Model::from_xml(text).is_err());
        }
        if let Ok(text) = std::str::from_utf8(&bytes)
            && let Ok(model) = Model::from_xml(text)
        {
            prop_assert!(model.nbody() >= 1);
        }
    }

    #[test]
    fn arbitrary_text_is_a_model_or_an_error(text in "\\PC{0,200}") {
        if let Err(error) = Model::from_xml(&text) {
            prop_assert!(!error.to_string().is_empty());
        }
    }
}
