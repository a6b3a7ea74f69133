//! Clips read back by another reader of glTF: the `gltf` crate, which checks what the format asks for.

use super::gltf::{GltfClip, MAX_CLIP_BYTES, MAX_CLIP_SCANS};
use glam::Vec3;
use gltf::json::validation::{Error, Validate};
use gltf::{Accessor, Gltf, Semantic};
use gv3_codec::{GreyPicture, mesh::TriMesh};
use proptest::prelude::*;
use std::path::Path;

fn path() -> &'static Path {
    Path::new("clip.glb")
}

/// A square of 25 vertices, its middle `lift_mm` high.
fn tent(lift_mm: f32) -> TriMesh {
    let positions_mm = (0..25).map(|i| {
        let (x, y) = ((i % 5) as f32 - 2.0, (i / 5) as f32 - 2.0);
        Vec3::new(40.0 * x, 30.0 * y, -600.0 + lift_mm * (2.0 - x.abs().max(y.abs())) / 2.0)
    });
    let triangles = (0..20).filter(|i| i % 5 != 4).flat_map(|i| [[i, i + 1, i + 6], [i, i + 6, i + 5]]).collect();
    let uv = (0..25).map(|i| [(i % 5) as f32 / 4.0, (i / 5) as f32 / 4.0]).collect();
    TriMesh { positions_mm: positions_mm.collect(), triangles, uv: Some(uv) }
}

/// Parses a file, which may differ from the format in nothing but the extension that the reader does not know.
fn parsed(bytes: &[u8]) -> Gltf {
    let gltf = Gltf::from_slice_without_validation(bytes).unwrap();
    let root = gltf.document.as_json();
    let mut faults = Vec::new();
    root.validate(root, gltf::json::Path::new, &mut |path, error| faults.push((path().to_string(), error)));
    let is_known = |path: &str| path.starts_with("extensionsRequired[0]") && path.contains("KHR_mesh_quantization");
    faults.retain(|(path, error)| !(is_known(path) && *error == Error::Unsupported));
    assert!(faults.is_empty(), "{faults:?}");
    gltf
}

/// Numbers of an accessor as they are stored, element by element.
fn numbers(gltf: &Gltf, accessor: &Accessor) -> Vec<Vec<f32>> {
    let view = accessor.view().unwrap();
    let (size, step) = (accessor.size(), view.stride().unwrap_or(accessor.size()));
    assert!(accessor.offset() + (accessor.count() - 1) * step + size <= view.length(), "beyond the view");
    assert!([accessor.offset(), view.offset(), step].iter().all(|at| at.is_multiple_of(4)), "not aligned");
    let blob = gltf.blob.as_ref().unwrap();
    assert!(view.offset() + view.length() <= blob.len(), "beyond the file");
    let all = &blob[view.offset()..view.offset() + view.length()];
    let wide = accessor.data_type().size();
    let element = |i: usize| all[accessor.offset() + i * step..][..size].chunks_exact(wide);
    let number = |bytes: &[u8]| match accessor.data_type() {
        gltf::accessor::DataType::I8 => f32::from(bytes[0] as i8),
        gltf::accessor::DataType::I16 => f32::from(i16::from_le_bytes([bytes[0], bytes[1]])),
        gltf::accessor::DataType::U16 => f32::from(u16::from_le_bytes([bytes[0], bytes[1]])),
        gltf::accessor::DataType::F32 => f32::from_le_bytes(bytes.try_into().unwrap()),
        gltf::accessor::DataType::U32 => u32::from_le_bytes(bytes.try_into().unwrap()) as f32,
        gltf::accessor::DataType::U8 => f32::from(bytes[0]),
    };
    let all: Vec<Vec<f32>> = (0..accessor.count()).map(|i| element(i).map(number).collect()).collect();
    check_bounds(accessor, &all);
    all
}

/// Bounds that a file gives are those of its numbers.
fn check_bounds(accessor: &Accessor, all: &[Vec<f32>]) {
    for (bounds, better) in [(accessor.min(), f32::min as fn(f32, f32) -> f32), (accessor.max(), f32::max)] {
        for (k, bound) in bounds.iter().flat_map(|b| b.as_array().unwrap()).enumerate() {
            let found = all.iter().map(|e| e[k]).reduce(better).unwrap();
            assert_eq!(bound.as_f64().unwrap() as f32, found, "bound {k}");
        }
    }
}

/// Positions of every scan of a clip, mm.
fn surfaces(gltf: &Gltf) -> Vec<Vec<Vec3>> {
    let node = gltf.nodes().next().unwrap();
    let (translation, _, scale) = node.transform().decomposed();
    let primitive = node.mesh().unwrap().primitives().next().unwrap();
    let vectors = |accessor: &Accessor, largest: f32| -> Vec<Vec3> {
        assert!(accessor.normalized() && accessor.min().is_some() && accessor.max().is_some());
        numbers(gltf, accessor).iter().map(|p| Vec3::new(p[0], p[1], p[2]) / largest).collect()
    };
    let first = vectors(&primitive.get(&Semantic::Positions).unwrap(), 65_535.0);
    let targets: Vec<Vec<Vec3>> =
        primitive.morph_targets().map(|t| vectors(&t.positions().unwrap(), 32_767.0)).collect();
    let placed = |moves: Option<&Vec<Vec3>>| {
        let at = |i: usize| first[i] + moves.map_or(Vec3::ZERO, |m| m[i]);
        (0..first.len()).map(|i| (Vec3::from(translation) + Vec3::from(scale) * at(i)) * 1000.0).collect()
    };
    std::iter::once(placed(None)).chain(targets.iter().map(|t| placed(Some(t)))).collect()
}

/// Largest distance between places, mm.
fn farthest(a: &[Vec3], b: &[Vec3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a.distance(*b)).fold(0.0, f32::max)
}

#[test]
fn a_clip_comes_back_as_it_went_in() {
    let scans = [0.0, 12.0, 40.0, -7.5].map(tent);
    let picture = GreyPicture::new(3, 2, vec![0, 50, 100, 150, 200, 250]);
    let mut clip = GltfClip::new(4, 1_000_000_000, &scans[0], Some(&picture));
    for (k, scan) in (1u64..).zip(&scans[1..]) {
        assert!(clip.takes(scan, 1_000_000_000 + k * 50_000_000));
        clip.add(4 + k, 1_000_000_000 + k * 50_000_000, scan, path()).unwrap();
    }
    let gltf = parsed(&clip.bytes(path()).unwrap());
    for (found, scan) in surfaces(&gltf).iter().zip(&scans) {
        assert!(farthest(found, &scan.positions_mm) < 160.0 / 32_767.0, "{}", farthest(found, &scan.positions_mm));
    }
    let primitive = gltf.meshes().next().unwrap().primitives().next().unwrap();
    let corners: Vec<f32> = numbers(&gltf, &primitive.indices().unwrap()).concat();
    assert_eq!(corners, scans[0].triangles.as_flattened().iter().map(|v| *v as f32).collect::<Vec<_>>());
    let uv = numbers(&gltf, &primitive.get(&Semantic::TexCoords(0)).unwrap());
    assert_eq!(uv[7], [0.5, 0.75], "from the top");
    for normal in numbers(&gltf, &primitive.get(&Semantic::Normals).unwrap()) {
        assert_eq!(normal, [0.0, 0.0, 127.0]);
    }
    let animation = gltf.animations().next().unwrap();
    let sampler = animation.channels().next().unwrap().sampler();
    assert_eq!(numbers(&gltf, &sampler.input()).concat(), [0.0, 0.05, 0.1, 0.15]);
    let weights = numbers(&gltf, &sampler.output()).concat();
    assert_eq!(weights, [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
    let image = gltf.images().next().unwrap().source();
    let gltf::image::Source::View { view, mime_type: "image/png" } = image else { panic!("no PNG inside") };
    let png = &gltf.blob.as_ref().unwrap()[view.offset()..][..view.length()];
    assert_eq!(super::picture::parse_picture(png, path()).unwrap(), picture);
}

#[test]
fn only_later_scans_of_the_same_connectivity_go_on_with_a_clip() {
    let clip = GltfClip::new(0, 10, &tent(0.0), None);
    let mut other = tent(0.0);
    other.triangles.pop();
    let mut larger = tent(0.0);
    larger.positions_mm.push(Vec3::ZERO);
    assert!(clip.takes(&tent(3.0), 11));
    assert!(!clip.takes(&tent(3.0), 10) && !clip.takes(&other, 11) && !clip.takes(&larger, 11));
}

#[test]
fn a_clip_that_grows_too_long_names_the_limit() {
    let fill = |mesh: &TriMesh| {
        let mut clip = GltfClip::new(0, 0, mesh, None);
        (1..).find_map(|k| clip.add(k, k, mesh, path()).err().map(|e| (k, e.to_string()))).unwrap()
    };
    let (count, reason) = fill(&tent(0.0));
    assert_eq!(count, MAX_CLIP_SCANS as u64);
    assert!(reason.starts_with("clip.glb: more than 600 scans of 25 vertices"), "{reason}");
    let large = TriMesh { positions_mm: vec![Vec3::ZERO; MAX_CLIP_BYTES / 12 / 3 - 1], ..TriMesh::default() };
    assert_eq!(fill(&large).0, 3);
}

#[test]
fn what_has_no_triangles_is_an_empty_scene() {
    let gltf = parsed(&GltfClip::new(3, 0, &TriMesh::default(), None).bytes(path()).unwrap());
    assert_eq!((gltf.nodes().count(), gltf.meshes().count(), gltf.blob), (1, 0, None));
}

proptest! {
    /// Wherever a surface is and however far it moves, places are kept to the steps of the cube about it.
    #[test]
    fn places_are_kept_to_a_step(
        start in prop::array::uniform3(-3000f32..3000.0),
        size in 0f32..500.0,
        moves in prop::collection::vec(prop::array::uniform3(-1f32..1.0), 1..6),
        reach in 0f32..2000.0,
    ) {
        let mut first = tent(10.0);
        first.positions_mm.iter_mut().for_each(|p| *p = Vec3::from(start) + *p * (size / 160.0));
        let scans: Vec<TriMesh> = moves.iter().map(|by| {
            let mut mesh = first.clone();
            let mut far = Vec3::from(*by) * reach;
            mesh.positions_mm.iter_mut().for_each(|p| { *p += far; far = -far; });
            mesh
        }).collect();
        let mut clip = GltfClip::new(0, 0, &first, None);
        for (k, scan) in (1..).zip(&scans) {
            clip.add(k, k * 1000, scan, path()).unwrap();
        }
        let gltf = parsed(&clip.bytes(path()).unwrap());
        let longest = scans.iter().map(|s| farthest(&s.positions_mm, &first.positions_mm)).fold(4.0 * size, f32::max);
        for (found, scan) in surfaces(&gltf).iter().skip(1).zip(&scans) {
            // Single precision itself steps by 0.0005 mm some metres away.
            prop_assert!(farthest(found, &scan.positions_mm) < longest / 32_767.0 + 0.01);
        }
    }
}
