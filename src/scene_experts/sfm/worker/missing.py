"""Why photographs have no pose."""

from __future__ import annotations

from typing import Any

FEW_FEATURES = 200  # a sharp photograph has thousands


def explain_missing(colmap: Any, ask: dict[str, Any], have: set[str], apart: set[str]) -> dict[str, str]:
    """Return why each photograph that is not in `have` has no pose, by name. apart: photographs
    with poses in a model of their own."""
    names = [name for group in ask["groups"] for name in group if name not in have]
    if not names:
        return {}
    with colmap.Database.open(ask["database"]) as there:
        by_name = {image.name: image.image_id for image in there.read_all_images()}
        features = {name: there.num_keypoints_for_image(by_name[name]) if name in by_name else 0 for name in names}
        pairs, inliers = there.read_two_view_geometry_num_inliers()
    shared: dict[int, dict[int, int]] = {}
    for pair, count in zip(pairs, inliers):
        one, other = colmap.pair_id_to_image_pair(pair)
        shared.setdefault(one, {})[other] = shared.setdefault(other, {})[one] = count
    posed = {by_name[name] for name in have if name in by_name}
    return {name: explain(features[name], shared.get(by_name.get(name, -1), {}), posed, name in apart) for name in names}


def explain(features: int, shared: dict[int, int], posed: set[int], apart: bool) -> str:
    """Return why a photograph has no pose.

    shared: The number of points that it shares with other photographs, by their id. posed: Ids of
    the photographs that have a pose.
    """
    with_posed = [count for other, count in shared.items() if other in posed and count]
    if features < FEW_FEATURES:
        return f"only {features} features: it is blurred, dark or plain"
    if apart:
        return "fits only together with others that are apart from the rest"
    if not any(shared.values()):
        return "no other photograph shows the same points; take one or two between it and its neighbours"
    if not with_posed:
        return "shares points only with photographs that have no pose either"
    return f"shares points with {len(with_posed)} photographs that have a pose, at most {max(with_posed)}, which did not fit a pose"
