use super::*;
use proptest::prelude::*;

fn parse(bytes: &[u8]) -> Result<MeshFile> {
    parse_ply(bytes, Path::new("a.ply"))
}

fn error(text: &str) -> String {
    parse(text.as_bytes()).unwrap_err().to_string()
}

fn header(format: &str, vertices: usize, faces: usize) -> String {
    format!(
        "ply\nformat {format} 1.0\nelement vertex {vertices}\nproperty float x\nproperty float y\nproperty float z\n\
         element face {faces}\nproperty list uchar int vertex_indices\nend_header\n"
    )
}

fn square() -> TriMesh {
    TriMesh {
        positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::new(1.0, 1.0, 0.0), Vec3::Y],
        triangles: vec![[0, 1, 2], [0, 2, 3]],
        uv: Some(vec![[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]),
    }
}

#[test]
fn ascii_with_quads_colours_and_unknown_elements() {
    let file = parse(
        b"ply\nformat ascii 1.0\ncomment TextureFile skin 1.bmp\nelement camera 1\nproperty float view_px\n\
          element vertex 4\nproperty double x\nproperty double y\nproperty double z\nproperty uchar red\n\
          property float texture_u\nproperty float texture_v\nelement note 2\nproperty list uchar char text\n\
          element face 1\nproperty uchar flags\nproperty list uint8 uint32 vertex_index\nend_header\n\
          3.5\n0 0 0 9 0.0 0.0\n1 0 0 9 1.0 0.0\n1 1 0 9 1.0 1.0\n0 1e0 0 9 0.0 1.0 \n2 65 66\n0\n1 4 0 1 2 3\n",
    )
    .unwrap();
    assert_eq!(file.mesh, square());
    assert_eq!(file.texture_reference.as_deref(), Some("skin 1.bmp"));
    assert!(file.repairs.is_clean());
}

#[test]
fn big_endian_and_odd_scalar_types() {
    let mut bytes =
        b"ply\r\nformat binary_big_endian 1.0\r\nelement vertex 3\r\nproperty short x\r\nproperty double y\r\n\
        property int8 z\r\nelement face 1\r\nproperty list ushort short vertex_indices\r\nend_header\r\n"
            .to_vec();
    for (x, y, z) in [(-300_i16, 0.5_f64, -1_i8), (1, 2.0, 3), (4, 5.0, 6)] {
        bytes.extend_from_slice(&x.to_be_bytes());
        bytes.extend_from_slice(&y.to_be_bytes());
        bytes.extend_from_slice(&z.to_be_bytes());
    }
    bytes.extend_from_slice(&[0, 3, 0, 2, 0, 1, 0, 0]);
    let mesh = parse(&bytes).unwrap().mesh;
    assert_eq!(mesh.positions_mm[0], Vec3::new(-300.0, 0.5, -1.0));
    assert_eq!(mesh.triangles, [[2, 1, 0]]);
    assert_eq!(mesh.uv, None);
}

#[test]
fn texture_coordinates_at_faces() {
    let text = header("ascii", 4, 2).replace("end_header", "property list uchar float texcoord\nend_header");
    let file =
        parse(format!("{text}0 0 0\n1 0 0\n1 1 0\n0 1 0\n3 0 1 2 6 0 0 1 0 1 1\n3 0 2 3 6 0.5 0 1 1 0 1\n").as_bytes());
    let file = file.unwrap();
    assert_eq!(file.mesh, square());
    assert_eq!(file.repairs.vertices_with_several_uv, 1);
}

#[test]
fn degenerate_faces_are_counted() {
    let text = header("ascii", 3, 3) + "0 0 0\n1 0 0\n1 1 0\n3 0 1 2\n3 0 0 1\n2 0 1\n";
    let repairs = parse(text.as_bytes()).unwrap().repairs;
    assert_eq!((repairs.degenerate_triangles, repairs.incomplete_faces), (1, 1));
}

#[test]
fn bad_files_are_named_by_place() {
    let points = "0 0 0\n1 0 0\n1 1 0\n";
    assert_eq!(error("solid\n"), "a.ply, byte 0: does not begin with `ply`; is this a PLY file?");
    assert!(error("ply\nformat ascii 1.0\n").contains("broken header: Unexpected end of file while reading header"));
    assert!(
        error("ply\nformat ascii 1.0\nelement vertex many\nend_header\n").starts_with("a.ply, line 3: broken header")
    );
    assert_eq!(
        error("ply\nformat ascii 1.0\nelement face 0\nproperty list uchar int vertex_indices\nend_header\n"),
        "a.ply: no element vertex with properties x, y, z; is this a mesh?"
    );
    assert!(error(&(header("ascii", 3, 0) + points)).starts_with("a.ply: no triangles, 3 vertices"));
    assert_eq!(error(&(header("ascii", 3, 1) + points + "3 0 1 3\n")), "a.ply: face 1 names vertex 3, of 0 to 2");
    assert!(error(&(header("ascii", 3, 1) + points + "3 0 1 -1\n")).contains("face 1 names vertex -1"));
    assert!(error(&(header("ascii", 3, 1) + "0 0 0\n1 0 x\n1 1 0\n3 0 1 2\n")).starts_with("a.ply, line 11: "));
    assert!(error(&(header("ascii", 3, 1) + "0 0 0\n1 1e99 0\n1 1 0\n3 0 1 2\n")).contains("vertex 2 is not finite"));
    let long = error(&(header("ascii", 3, 1) + points + "3 0 1 " + &"9".repeat(100_000)));
    assert!(long.len() < 400, "{long}");
}

#[test]
fn counts_are_held_against_the_bytes_before_memory_is_taken() {
    for encoding in ["ascii", "binary_little_endian"] {
        let text = error(&header(encoding, 16_000_000, 1));
        assert!(text.contains("16000000 elements vertex announced, but only 0 bytes follow"), "{text}");
        assert!(error(&header(encoding, 17_000_000, 1)).contains("more than the limit"));
        assert!(error(&header(encoding, usize::MAX, 1)).contains("more than the limit"));
        let empty = format!("ply\nformat {encoding} 1.0\nelement nothing 99999999999\nend_header\n");
        assert!(error(&empty).contains("element nothing has no properties; remove it"));
    }
    let list = header("binary_little_endian", 0, 1).replace("uchar int", "uint int");
    let mut bytes = list.into_bytes();
    bytes.extend_from_slice(&u32::MAX.to_le_bytes());
    let text = parse(&bytes).unwrap_err().to_string();
    assert!(text.contains("cut short or damaged?") && text.contains("'face'"), "{text}");
}

#[test]
fn golden_bytes() {
    let mesh = TriMesh {
        positions_mm: vec![Vec3::ZERO, Vec3::X, Vec3::Y],
        triangles: vec![[0, 1, 2]],
        uv: Some(vec![[0.0, 1.0]; 3]),
    };
    let mut expected = b"ply\nformat binary_little_endian 1.0\ncomment TextureFile a.bmp\nelement vertex 3\n\
        property float x\nproperty float y\nproperty float z\nproperty float s\nproperty float t\nelement face 1\n\
        property list uchar int vertex_indices\nend_header\n"
        .to_vec();
    let one = [0, 0, 0x80, 0x3f];
    for ones in [[0, 0, 0, 0, 1], [1, 0, 0, 0, 1], [0, 1, 0, 0, 1]] {
        expected.extend(ones.iter().flat_map(|&is_one| if is_one == 1 { one } else { [0; 4] }));
    }
    expected.extend_from_slice(&[3, 0, 0, 0, 0, 1, 0, 0, 0, 2, 0, 0, 0]);
    assert_eq!(ply_bytes(&mesh, Some("a.bmp")), expected);
}

proptest! {
    #[test]
    fn what_is_written_is_read_back_bit_for_bit(
        points in prop::collection::vec([-1e6_f32..1e6, -1e6_f32..1e6, -1e6_f32..1e6], 3..40),
        picks in prop::collection::vec([0..1000_u32, 0..1000, 0..1000], 0..40),
        uv in prop::option::of(0.0_f32..1.0),
    ) {
        let n = points.len() as u32;
        let mesh = TriMesh {
            triangles: picks.iter().map(|t| t.map(|v| v % n)).filter(|t| t[0] != t[1] && t[1] != t[2] && t[2] != t[0])
                .chain([[2, 1, 0]]).collect(),
            uv: uv.map(|u| (0..n).map(|i| [u, i as f32]).collect()),
            positions_mm: points.into_iter().map(Vec3::from_array).collect(),
        };
        let file = parse(&ply_bytes(&mesh, None)).unwrap();
        prop_assert!(file.repairs.is_clean());
        prop_assert_eq!(file.mesh, mesh);
    }
}
