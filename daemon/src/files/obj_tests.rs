use super::*;
use proptest::prelude::*;

const SQUARE: &str = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n";

fn parse(text: &str) -> Result<MeshFile> {
    parse_obj(text.as_bytes(), Path::new("a.obj"))
}

fn error(text: &str) -> String {
    parse(text).unwrap_err().to_string()
}

#[test]
fn file_order_is_kept_though_faces_use_another_and_leave_vertices_out() {
    let file = parse("v 0 0 9\nv 1 0 0\nv 2 0 0\nv 3 0 0\nv 4 0 0\nf 5 4 2\nf 2 4 3\n").unwrap();
    assert_eq!(file.mesh.positions_mm[0], Vec3::new(0.0, 0.0, 9.0));
    assert_eq!(file.mesh.triangles, [[4, 3, 1], [1, 3, 2]]);
    assert_eq!(file.mesh.uv, None);
    assert!(file.repairs.is_clean());
}

#[test]
fn polygons_become_fans_and_objects_and_groups_are_merged() {
    let text = format!(
        "mtllib no such file.mtl\n{SQUARE}o one\nusemtl skin\nf 1 2 3 4\ng two\nv 0 2 0\nf 4 3 5\nl 1 2\np 1\n"
    );
    let file = parse(&text).unwrap();
    assert_eq!(file.mesh.triangles, [[0, 1, 2], [0, 2, 3], [3, 2, 4]]);
    assert_eq!(file.texture_reference.as_deref(), Some("no such file.mtl"));
    let pentagon = parse(&format!("{SQUARE}v 0 2 0\nf 1 2 3 5 4\n")).unwrap();
    assert_eq!(pentagon.mesh.triangles, [[0, 1, 2], [0, 2, 4], [0, 4, 3]]);
}

#[test]
fn relative_indices_count_back_from_the_face() {
    let file = parse(&format!("{SQUARE}f -4 -3 -2\nv 9 9 9\nf -5 -3 -2\n")).unwrap();
    assert_eq!(file.mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!(
        error(&format!("{SQUARE}f -5 -3 -2\nv 9 9 9\n")),
        "a.obj, line 5: a face names vertex -5, but only 4 stand before it"
    );
    let i64_min = i64::MIN;
    assert!(
        error(&format!("{SQUARE}vt 0 0\nf 1/{i64_min} 2/1 3/1\n")).contains("line 6: a face names texture coordinate")
    );
}

#[test]
fn texture_coordinates_follow_their_vertices() {
    let file = parse(&format!("{SQUARE}vt 0.4 0\nvt 0.3 0\nvt 0.2 0\nvt 0.1 0\nf 1/4/7 2/3/7 3/2/7\nf 1/4 3/2 4/1\n"));
    let file = file.unwrap();
    assert_eq!(file.mesh.uv.unwrap(), [[0.1, 0.0], [0.2, 0.0], [0.3, 0.0], [0.4, 0.0]]);
    assert!(file.repairs.is_clean());
}

#[test]
fn several_and_missing_texture_coordinates_are_counted() {
    let file =
        parse(&format!("{SQUARE}vt 0.1 0\nvt 0.2 0\nvt 0.1 0\nf 1/1 2/2 3\nf 1/2 3 4/2\nf 1/3 2/2 3\n")).unwrap();
    assert_eq!(file.mesh.uv.unwrap(), [[0.1, 0.0], [0.2, 0.0], [0.0, 0.0], [0.2, 0.0]]);
    assert_eq!((file.repairs.vertices_with_several_uv, file.repairs.vertices_without_uv), (1, 1));
}

#[test]
fn faces_that_repeat_a_vertex_or_lack_corners_are_counted() {
    let file = parse(&format!("{SQUARE}f 1 2 3\nf 1 1 2\nf 1 2\nf\nf 1 3 3 4\n")).unwrap();
    assert_eq!(file.mesh.triangles, [[0, 1, 2], [0, 2, 3]]);
    assert_eq!((file.repairs.degenerate_triangles, file.repairs.incomplete_faces), (2, 2));
}

#[test]
fn colours_weights_comments_continued_lines_and_windows_text_are_read() {
    let file = parse(
        "\u{feff}v 0 0 0 0.5 0.5 0.5\r\nv 2 0 0 2 # weight\r\n#n\u{e9}\r\nv 0 1 \\\r\n0 # end\r\nf 1 \\\r\n2 3#\r\n",
    );
    // `3#` is no number: the comment needs a space before it, as everywhere in OBJ.
    assert_eq!(
        file.unwrap_err().to_string(),
        "a.obj, line 6: `3#` is not a vertex number; a face is `f v/vt v/vt v/vt`"
    );
    let file =
        parse("v 0 0 0 0.5 0.5 0.5\r\nv 2 0 0 2 # weight\r\nv 0 1 \\\r\n0 # end\r\nf 1 \\\r\n2 3 # c\r\n").unwrap();
    assert_eq!(file.mesh.positions_mm, [Vec3::ZERO, Vec3::X, Vec3::Y]);
    assert_eq!(file.mesh.triangles, [[0, 1, 2]]);
}

#[test]
fn bad_text_is_named_by_its_line() {
    assert_eq!(error(""), "a.obj: no vertices (`v` lines); is this an OBJ file?");
    assert!(error(SQUARE).starts_with("a.obj: no triangles, 4 vertices"));
    assert!(
        error(&format!("{SQUARE}f 1 1 1\n")).contains("no triangles, 4 vertices (1 triangles that repeat a vertex")
    );
    assert_eq!(
        error(&format!("{SQUARE}f 1 2 3\nf 1 2 5\n")),
        "a.obj, line 6: a face names vertex 5, but the file has 4; is it cut short?"
    );
    assert_eq!(error(&format!("{SQUARE}f 0 1 2\n")), "a.obj, line 5: a face names vertex 0; OBJ counts from 1");
    assert!(error(&format!("{SQUARE}f 1 2 99999999999999999999\n")).contains("line 5: `99999999999999999999` is not"));
    assert!(error(&format!("{SQUARE}f 1 2 18446744073709551615\n")).contains("line 5"));
    assert!(error(&format!("{SQUARE}f 1/9 2/9 3/9\n")).contains("texture coordinate 9, but the file has 0"));
    assert_eq!(error("v 0 0 0\nv 1 x 0\nf 1 1 1\n"), "a.obj, line 2: a vertex needs three numbers, `v x y z`");
    assert_eq!(error("v 0 0 0\nv 1 0\nf 1 1 1\n"), "a.obj, line 2: a vertex needs three numbers, `v x y z`");
    assert_eq!(error("v 0 0 0 0\nf 1 1 1\n"), "a.obj, line 1: the fourth number of a vertex, its weight, is zero");
    assert_eq!(error("v 0 0 0\nvt 1\nf 1 1 1"), "a.obj, line 2: a texture coordinate needs two numbers, `vt u v`");
    assert_eq!(
        parse_obj(b"v 0 0 \xff\n", Path::new("b")).unwrap_err().to_string(),
        "b, line 1: not text; is this an OBJ file?"
    );
}

#[test]
fn numbers_that_are_not_finite_are_named() {
    for bad in ["nan", "inf", "-inf", "1e999"] {
        assert_eq!(
            error(&format!("# head\n{SQUARE}v 0 {bad} 0\nf 1 2 3\n")),
            "a.obj, line 6: vertex 5 is not finite; remove it and its faces"
        );
        assert!(error(&format!("{SQUARE}vt 0 0\nvt {bad} 0\nf 1 2 3\n")).contains("line 6: texture coordinate 2"));
    }
}

#[test]
fn a_file_that_is_not_there_is_named() {
    let error = read_obj(Path::new("/no/such.obj")).unwrap_err().to_string();
    assert!(error.starts_with("/no/such.obj: cannot open: "), "{error}");
}

#[test]
fn golden_text() {
    let mesh = TriMesh {
        positions_mm: vec![
            Vec3::new(-0.00001, 1.5, -2.25),
            Vec3::new(12.34567, 0.0, 1e6),
            Vec3::new(0.0, -0.99999, 3.0),
        ],
        triangles: vec![[0, 1, 2]],
        uv: Some(vec![[0.0, 1.0], [0.25, 0.1234567], [1.0, 0.0]]),
    };
    let material = Material { library: "a.mtl", picture: "a.bmp" };
    assert_eq!(
        String::from_utf8(obj_bytes(&mesh, Some(material))).unwrap(),
        "mtllib a.mtl\nusemtl scan\nv 0.0000 1.5000 -2.2500\nv 12.3457 0.0000 1000000.0000\nv 0.0000 -1.0000 3.0000\n\
         vt 0.000000 1.000000\nvt 0.250000 0.123457\nvt 1.000000 0.000000\nf 1/1 2/2 3/3\n"
    );
    assert_eq!(material.library_text(), "newmtl scan\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd a.bmp\n");
}

fn any_mesh() -> impl Strategy<Value = TriMesh> {
    (3_usize..40, any::<bool>()).prop_flat_map(|(n, is_textured)| {
        let corner = 0..n as u32;
        (
            prop::collection::vec([-500_000_i32..500_000, -500_000..500_000, -500_000..500_000], n),
            prop::collection::vec([0..=1_000_000_u32, 0..=1_000_000], n),
            prop::collection::vec([corner.clone(), corner.clone(), corner], 1..60),
        )
            .prop_map(move |(points, uv, triangles)| TriMesh {
                positions_mm: points.iter().map(|p| Vec3::from_array(p.map(|x| x as f32 / 1e4))).collect(),
                triangles: triangles
                    .into_iter()
                    .filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0])
                    .chain([[0, 1, 2]])
                    .collect(),
                uv: is_textured.then(|| uv.iter().map(|t| t.map(|x| x as f32 / 1e6)).collect()),
            })
    })
}

proptest! {
    #[test]
    fn the_length_is_counted_as_it_is_written(
        numbers in prop::collection::vec(prop_oneof![
            any::<f32>(), -700.0f32..700.0, -1e-4f32..1e-4, Just(9.999_95), Just(-99.999_95), Just(999.999_9), Just(0.999_999_5),
        ], 15..60),
        far in 0u32..2_000_000_000,
        is_textured: bool,
    ) {
        let positions_mm: Vec<Vec3> = numbers.chunks_exact(5).map(|n| Vec3::new(n[0], n[1], n[2])).collect();
        let uv = is_textured.then(|| numbers.chunks_exact(5).map(|n| [n[3], n[4]]).collect());
        // What is written need not be a surface.
        let mesh = TriMesh { positions_mm, triangles: vec![[0, 9, far], [8, 99, 98], [far / 1000, 999, 10]], uv };
        for material in [None, Some(Material { library: "frame_0001.mtl", picture: "frame_0001.bmp" })] {
            prop_assert_eq!(obj_byte_count(&mesh, material), obj_bytes(&mesh, material).len() as u64);
        }
    }

    #[test]
    fn what_is_written_is_read_back(mesh in any_mesh()) {
        let file = parse_obj(&obj_bytes(&mesh, None), Path::new("a.obj")).unwrap();
        prop_assert!(file.repairs.is_clean());
        prop_assert_eq!(file.mesh.triangles, mesh.triangles);
        for (a, b) in file.mesh.positions_mm.iter().zip(&mesh.positions_mm) {
            prop_assert!((*a - *b).abs().max_element() <= 1e-5, "{} {}", a, b);
        }
        prop_assert_eq!(file.mesh.uv.is_some(), mesh.uv.is_some());
        for (a, b) in file.mesh.uv.iter().flatten().zip(mesh.uv.iter().flatten()) {
            prop_assert!((a[0] - b[0]).abs() <= 6e-7 && (a[1] - b[1]).abs() <= 6e-7);
        }
    }

    #[test]
    fn fixed_point_numbers_are_those_of_the_standard_library(x in -1e9_f32..1e9, small in -2_f32..2.0) {
        for x in [x, small] {
            let mut text = Vec::new();
            push_fixed::<4>(&mut text, x);
            let expected = format!("{x:.4}");
            let expected = if expected == "-0.0000" { "0.0000" } else { &expected };
            prop_assert_eq!(std::str::from_utf8(&text).unwrap(), expected);
        }
    }
}
